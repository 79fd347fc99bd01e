"""Reconstruction of one planned capture on a worker: read, check, solve, score, store.

Nothing here needs Dask: a bare process computes the same bytes.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from device import atomic_io
from device.clock import Clock, SystemClock
from device.config.image_files import only_frame, read_image_file
from device.config.marked_files import tiff_bytes
from device.errors import CalibrationError, FrameError, PsfError, SettingError, SpecError, StoreError
from device.recon.model.fft_plans import Planner
from device.values import Colour, Image
from services.archive.content import different_versions, digest_of, software
from services.archive.plan import COLOUR_ROLES, PlannedCalibration, PlannedCapture, PlanSettings, Role
from services.archive.result import (
    COLOUR_PICTURE,
    PICTURE,
    REPORT,
    RUN,
    Quarantined,
    ResultFolder,
    encoded_document,
)
from services.archive.source_files import earlier_picture, source_content
from services.imaging.raw_metadata import RawMetadata
from services.lru_cache import LruCache
from services.research.pair_scores import PairScorer
from services.research.reconstruct_capture import (
    CaptureFrames,
    CaptureReconstruction,
    CaptureReconstructor,
    frames_of_capture,
)
from services.research.reconstruct_inputs import ReconstructOptions, stated_by

KEPT_SOLVERS = 2  # captures come sorted by calibration; a solver takes up to about 300 MB at full sensor size
EFFORT = "FFTW_ESTIMATE"  # plans by rule, not by measurement: two processes add in the same order
AGAIN = "After that make a new plan, and run it into the same folder."
REFUSED = (FrameError, PsfError, CalibrationError, SettingError, SpecError)


@dataclass(frozen=True)
class Task:
    """One capture with all that decides about its result, apart from the content of the files."""

    capture: PlannedCapture
    calibration: PlannedCalibration
    settings: PlanSettings
    software: dict[str, str]


@dataclass(frozen=True)
class Outcome:
    """End of one task: the seconds it took; `failure` is None if the result is stored."""

    name: str
    seconds: float
    failure: Quarantined | None = None


class CalibrationFiles:
    """Local copies of the files of calibrations, in one folder for each digest."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def add(self, digest: str, files: Mapping[str, bytes]) -> None:
        """Write the files of a calibration; `files` are contents by local name. OSError if the disk refuses."""
        for name, content in files.items():
            path = self._root / digest / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)

    def options(self, calibration: PlannedCalibration, settings: PlanSettings) -> ReconstructOptions:
        """Return the options of a reconstruction with the local copies of a calibration."""
        place = self._root / calibration.digest
        return ReconstructOptions(
            psfs=self.paths(calibration, "psf"),
            method=settings.method,
            budget_s=settings.budget_s,
            dark=next(iter(self.paths(calibration, "dark")), None),
            flat=next(iter(self.paths(calibration, "flat")), None),
            rounds=settings.rounds,
            calibration=f"{place}:{calibration.id}" if calibration.id else None,
        )

    def paths(self, calibration: PlannedCalibration, role: Role) -> tuple[Path, ...]:
        """Return the local copies of the files of a calibration with this role."""
        place = self._root / calibration.digest
        return tuple(place / name for found, name in local_names(calibration) if found == role)


def local_names(calibration: PlannedCalibration) -> list[tuple[Role, str]]:
    """Return role and local name of each file of a calibration; that of an archive is ID/NAME, PSFs are numbered."""
    names: list[tuple[Role, str]] = []
    for number, file in enumerate(calibration.files):
        plain = Path(file.path).name
        names.append((file.role, f"{calibration.id}/{plain}" if file.role == "archive" else f"{number}-{plain}"))
    return names


class Solvers:
    """Planned solvers of one worker by calibration and settings, and reconstruction with them. Not thread-safe."""

    def __init__(self, calibrations: CalibrationFiles, clock: Clock | None = None) -> None:
        self._calibrations = calibrations
        self._clock = clock or SystemClock()
        self._planner = Planner(None, effort=EFFORT)
        self._kept = LruCache[tuple[str, str], CaptureReconstructor](KEPT_SOLVERS)

    def solve(self, task: Task, results: ResultFolder, worker: str) -> Outcome:
        """Reconstruct a capture and store its result; a result that is there already stays.

        The failure of a capture is part of the outcome. OSError only if the result cannot be written.
        """
        begin_s = self._clock.now_s()
        name = task.capture.result
        if results.has(name):
            return Outcome(name, 0.0)
        if found := different_versions(task.software, software()):
            failure = Quarantined(name, "versions", f"{worker} has other versions: {found}", retry=True)
            return Outcome(name, 0.0, failure)
        with TemporaryDirectory(prefix="capture-", dir=atomic_io.memory_folder()) as spool:
            made = self._made(task, Path(spool))
        if isinstance(made, Quarantined):
            return Outcome(name, self._clock.now_s() - begin_s, made)
        total_s = self._clock.now_s() - begin_s
        run = {
            "seconds": made.solved.made.report.seconds,
            "total_s": total_s,
            "worker": worker,
            "finished_at": self._clock.wall().isoformat(timespec="seconds"),
        }
        simulated = made.solved.made.simulated
        files = {
            PICTURE: tiff_bytes(made.solved.made.picture, simulated),
            REPORT: encoded_document(_report(task, made)),
            RUN: encoded_document(run),
        }
        if made.solved.colour is not None:
            files[COLOUR_PICTURE] = tiff_bytes(made.solved.colour, simulated)
        results.add(name, files)
        return Outcome(name, self._clock.now_s() - begin_s)

    def _made(self, task: Task, spool: Path) -> "_Made | Quarantined":
        """Return the reconstruction of a capture, from plain copies of its files that have the planned digests."""
        capture = task.capture
        name = task.capture.result
        try:
            frames = _copied_frames(capture, spool)
        except OSError as error:
            return Quarantined(name, "source", f"{error.filename}: {error.strerror}", "Give the source again.", True)
        except (FrameError, StoreError) as error:
            return Quarantined(name, "changed", error.message, error.remedy, retry=True)
        try:
            solved = self._solver(task)(frames)
            scores = _scores(solved.made.picture, capture)
        except REFUSED as error:
            remedy = f"{error.remedy} {AGAIN}".strip()
            return Quarantined(name, error.code, error.message.replace(f"{spool}/raw/", ""), remedy)
        return _Made(solved, _facts(stated_by(frames.lit[0])), scores)

    def _solver(self, task: Task) -> CaptureReconstructor:
        key = task.calibration.digest, digest_of(task.settings.model_dump())  # a worker may outlive a plan
        return self._kept.get_or_make(key, lambda: self._planned(task))

    def _planned(self, task: Task) -> CaptureReconstructor:
        options = self._calibrations.options(task.calibration, task.settings)
        of_colours: dict[Colour, ReconstructOptions] = {
            colour: replace(options, psfs=paths)
            for colour, role in COLOUR_ROLES.items()
            if (paths := self._calibrations.paths(task.calibration, role))
        }
        return CaptureReconstructor(options, self._planner, of_colours)


@dataclass(frozen=True)
class _Made:
    solved: CaptureReconstruction
    facts: dict[str, object]
    scores: dict[str, float]


def _copied_frames(capture: PlannedCapture, spool: Path) -> CaptureFrames:
    """Return copies of all frames of a capture, whose contents have the planned digests; errors as in `_copied`."""
    lit = [_copied(capture.raw, capture.raw_sha256, spool / "raw")]
    colours = dict[Colour, list[Path]]()
    unusable = dict[int, str]()
    for frame in capture.frames:
        copy = _copied(frame.path, frame.sha256, spool / "raw")
        if frame.colour:
            colours.setdefault(frame.colour, []).append(copy)
        else:
            unusable |= {len(lit): frame.unusable} if frame.unusable else {}
            lit.append(copy)
    dark = _copied(capture.dark, capture.dark_sha256, spool / "dark") if capture.dark else None
    return frames_of_capture(lit, colours, dark, unusable)


def _copied(path: str, digest: str, folder: Path) -> Path:
    """Return a plain copy of a file, whose content has the digest; FrameError for another, else as `source_content`."""
    content = source_content(Path(path))
    if hashlib.sha256(content).hexdigest() != digest:
        raise FrameError(
            f"{Path(path).name} has another content than when it was planned", "Restore it, or make a new plan."
        )
    folder.mkdir(exist_ok=True)
    copy = folder / Path(path).name
    copy.write_bytes(content)
    return copy


def _facts(stated: RawMetadata | None) -> dict[str, object]:
    if stated is None:
        return {}
    light = stated.illumination
    facts: dict[str, object] = {"exposure_s": stated.exposure_s, "head": stated.head}
    return facts | ({} if light is None else {"colour": light.colour, "light_level": light.level})


def _scores(picture: Image, capture: PlannedCapture) -> dict[str, float]:
    """Return PSNR (dB) and correlation with the truth, of the picture and of the earlier one, where they fit."""
    if not capture.truth:
        return {}
    truth = read_linear(Path(capture.truth))
    if truth.shape[:2] != picture.shape[:2]:
        return {}
    inside = np.isfinite(truth if truth.ndim == 2 else truth.sum(axis=2))
    inside &= (truth if truth.ndim == 2 else truth.max(axis=2)) > 0
    score = PairScorer(truth, inside)
    psnr, _, pcc = score(picture)
    found = {"psnr_db": psnr, "pcc": pcc}
    if capture.before and (before := earlier_picture(Path(capture.before))).shape[:2] == truth.shape[:2]:
        psnr, _, pcc = score(before)
        found |= {"before_psnr_db": psnr, "before_pcc": pcc}
    return found


def read_linear(path: Path) -> Image:
    """Return an image file as float32, (rows, cols) or (rows, cols, 3); FrameError if it cannot be read."""
    return np.asarray(only_frame(read_image_file(path).frames, str(path)), np.float32)


def _report(task: Task, made: _Made) -> dict[str, object]:
    """Return the document of a result: provenance, report without durations, facts of the raw frame, scores.

    `field_px`: first row, last row + 1, first and last column + 1 of the lit field.
    """
    solved = made.solved
    report = asdict(solved.made.report)
    del report["seconds"]
    rows, cols = solved.made.picture.shape[:2]
    (top, bottom, _), (left, right, _) = (span.indices(n) for span, n in zip(solved.box, (rows, cols), strict=True))
    return {
        "capture": task.capture.model_dump(),
        "calibration": task.calibration.model_dump(),
        "settings": task.settings.model_dump(),
        "software": task.software,
        "report": report,
        "raw": made.facts,
        "scores": made.scores,
        "rows": rows,
        "cols": cols,
        "simulated": solved.made.simulated,
        "field_px": [top, bottom, left, right],
    }
