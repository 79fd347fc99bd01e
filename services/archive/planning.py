"""`diffuscope archive plan`: the captures of all sources with their digests, calibrations and names of results."""

from collections.abc import Callable, Sequence
from pathlib import Path

from device.calibration.archive import MANIFEST, parse_calibration
from device.clock import Clock
from device.errors import FrameError, SettingError
from services.archive.content import digest_of, file_digest, result_name, software
from services.archive.plan import (
    InputFile,
    LeftOut,
    Plan,
    PlannedCalibration,
    PlannedCapture,
    PlannedFrame,
    PlanSettings,
)
from services.archive.sources import (
    FoundCalibration,
    FoundCapture,
    FoundFrame,
    archived_calibrations,
    find_captures,
    is_store,
)
from services.research.reconstruct_file import refuse_invalid_settings
from services.research.reconstruct_inputs import ReconstructOptions

STEP = 500  # captures between two lines of progress


def make_plan(sources: Sequence[Path], settings: PlanSettings, clock: Clock, progress: Callable[[str], None]) -> Plan:
    """Return the plan for all captures of the sources; nothing is written.

    A capture that cannot be planned is in `left_out` with its reason: no raw frame or an empty one, no calibration, or
    the content of another capture. Raw frames are read for their SHA-256, those of a store not. `progress` gets lines
    of text.
    SettingError for a folder that is no source, or for settings that no reconstruction can have.
    """
    _refuse_settings(settings)
    planning = _Planning(settings)
    places = [source.resolve() for source in sources]
    calibrations = {id: folder for place in places for id, folder in archived_calibrations(place).items()}
    for place in places:
        if not is_store(place) and calibrations and any(place in folder.parents for folder in calibrations.values()):
            continue  # an archive of calibrations for the stores among the sources
        for found in find_captures(place, calibrations):
            planning.add(found, place)
            if planning.count % STEP == 0:
                progress(f"{planning.count} captures found")
    return Plan(
        made_at=clock.wall().isoformat(timespec="seconds"),
        sources=tuple(map(str, places)),
        settings=settings,
        software=software(),
        calibrations=tuple(planning.calibrations.values()),
        captures=tuple(planning.captures.values()),
        left_out=tuple(planning.left_out),
    )


class _Planning:
    """A plan that grows by one capture after the other."""

    def __init__(self, settings: PlanSettings) -> None:
        self.calibrations: dict[str, PlannedCalibration] = {}
        self.captures: dict[str, PlannedCapture] = {}
        self.left_out: list[LeftOut] = []
        self._settings = settings.model_dump()
        self._seen: dict[FoundCalibration, PlannedCalibration] = {}

    @property
    def count(self) -> int:
        """Number of captures so far, with those that are left out."""
        return len(self.captures) + len(self.left_out)

    def add(self, found: FoundCapture, source: Path) -> None:
        """Plan one capture, or leave it out with its reason."""
        try:
            self._add(found, source)
        except OSError as error:
            self._leave_out(found, source, f"it cannot be read: {error.strerror or error}")
        except FrameError as error:
            self._leave_out(found, source, error.message)

    def _add(self, found: FoundCapture, source: Path) -> None:
        if found.calibration is None:
            self._leave_out(found, source, found.refused or "it has no calibration")
            return
        if found.raw_sha256 is None and found.raw.stat().st_size == 0:
            self._leave_out(found, source, "its raw frame is an empty file")
            return
        calibration = self._calibration(found.calibration)
        raw_digest = found.raw_sha256 or file_digest(found.raw)
        dark_digest = "" if found.dark is None else found.dark_sha256 or file_digest(found.dark)
        frames = tuple(_planned_frame(frame) for frame in found.frames)
        content = [
            ("raw", raw_digest, ""),
            *((frame.colour or "burst", frame.sha256, frame.unusable) for frame in frames),
        ]
        content += [("dark", dark_digest, "")] if found.dark is not None else []
        name = result_name(content, calibration.digest, software(), self._settings)
        if (same := self.captures.get(name)) is not None:
            self._leave_out(found, source, f"it has the same content as {same.id}")
            return
        self.captures[name] = PlannedCapture(
            id=found.id,
            source=str(source),
            raw=str(found.raw),
            raw_sha256=raw_digest,
            result=name,
            calibration=calibration.digest,
            frames=frames,
            dark=_text(found.dark),
            dark_sha256=dark_digest,
            truth=_text(found.truth),
            before=_text(found.before),
            report=_text(found.report),
            device=found.device,
            origin=found.origin,
            eye=found.eye,
            taken_at=found.taken_at,
        )

    def _calibration(self, found: FoundCalibration) -> PlannedCalibration:
        """Return the planned calibration of these files; each file is read once."""
        if found not in self._seen:
            planned = _planned(found)
            self._seen[found] = self.calibrations.setdefault(planned.digest, planned)
        return self._seen[found]

    def _leave_out(self, found: FoundCapture, source: Path, reason: str) -> None:
        self.left_out.append(LeftOut(id=found.id, source=str(source), raw=str(found.raw), reason=reason))


def _planned_frame(frame: FoundFrame) -> PlannedFrame:
    sha256 = frame.sha256 or file_digest(frame.path)
    return PlannedFrame(path=str(frame.path), sha256=sha256, colour=frame.colour, unusable=frame.unusable)


def _planned(found: FoundCalibration) -> PlannedCalibration:
    files = tuple(InputFile(role=role, path=str(path), sha256=file_digest(path)) for role, path in found.files)
    digest = digest_of([(file.role, file.sha256) for file in files])
    if found.archived is None:
        return PlannedCalibration(digest=digest, label=found.psfs[0].name, files=files)
    kept = parse_calibration({Path(file.path).name: Path(file.path).read_bytes() for file in files})
    made_at = kept.provenance.made_at.isoformat()
    label = kept.provenance.serial
    assert MANIFEST in {Path(file.path).name for file in files}
    return PlannedCalibration(digest=digest, label=label, files=files, id=found.archived.name, made_at=made_at)


def _text(path: Path | None) -> str:
    return "" if path is None else str(path)


def _refuse_settings(settings: PlanSettings) -> None:
    """Raise SettingError for settings that contradict each other, or that the solver refuses."""
    if settings.rounds is not None and settings.budget_s is not None:
        raise SettingError("rounds and seconds limit the same", "Give --rounds or --budget-s, not both.")
    refuse_invalid_settings(
        ReconstructOptions(method=settings.method, budget_s=settings.budget_s, rounds=settings.rounds)
    )
