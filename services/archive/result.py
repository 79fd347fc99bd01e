"""Folder of results: one folder for each capture, named by content, and one file for each capture in quarantine.

plan.toml                       the plan that is computed here
earlier-plans/<digest>.toml     plans that were computed here before it
results/<ab>/<name>/            one result, renamed into place when it is complete; <ab> are the first two digits
    picture.tiff                linear float32, rows x cols (x 3) of the raw frame
    colour.tiff                 picture in red, green and blue of a capture in several colours of light, cropped to its
                                field, rows x cols x 3; absent without one
    report.json                 provenance, report and scores: equal for equal input, settings and versions
    run.json                    durations, worker and time, which differ from run to run
quarantine/<name>.json          a capture that failed, with the reason; the next run tries it again if `retry` is true
captures.parquet                one row for each capture
.lock                           held by the run that writes here
"""

import json
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

from device import atomic_io
from device.errors import SettingError
from device.user_files import files_in
from services.archive.content import file_digest
from services.archive.plan import Plan, encoded, read_plan
from services.records.capture import CaptureReport
from services.research.reconstruct_file import write_or_raise

COLOUR_PICTURE = "colour.tiff"
EARLIER_PLANS, QUARANTINE = "earlier-plans", "quarantine"
PICTURE, REPORT, RUN, PLAN, TABLE = "picture.tiff", "report.json", "run.json", "plan.toml", "captures.parquet"


@dataclass(frozen=True)
class Quarantined:
    """A capture without a result: name of the result, error code, reason, remedy, and whether the next run retries it.

    `id`: that of the capture in the plan.
    """

    name: str
    code: str
    reason: str
    remedy: str = ""
    retry: bool = False
    id: str = ""


@dataclass(frozen=True)
class Stored:
    """The two JSON documents of a stored result, and what adoption and report read of them."""

    report: Mapping[str, object]
    run: Mapping[str, object]

    @property
    def simulated(self) -> bool:
        """Whether a frame was simulated."""
        return self.report.get("simulated") is not False

    @property
    def method(self) -> str:
        """Method of the reconstruction."""
        return self.reconstruction.method

    @property
    def predicted(self) -> tuple[str, ...]:
        """Colours of the picture in colour that were not measured."""
        return tuple(channel.name for channel in self.reconstruction.channels if channel.predicted)

    @property
    def field_px(self) -> tuple[int, int, int, int]:
        """First row, last row + 1, first column, last column + 1 of the lit field."""
        match self.report.get("field_px"):
            case [int(top), int(bottom), int(left), int(right)]:
                return top, bottom, left, right
        raise SettingError("a result does not state its field", "Run the plan again with this release.")

    @property
    def reconstruction(self) -> CaptureReport:
        """Report of the reconstruction; SettingError if it, or what it says of its colours, cannot be read."""
        stored = self.report.get("report")
        try:
            report = CaptureReport.read(stored)
            if not report.channels and isinstance(stored, dict) and stored.get("channels"):
                raise ValueError("channels: of another form")  # they say which colours are predicted
        except ValueError as error:
            message = f"a result's report cannot be read: {error}"
            raise SettingError(message, "Delete the result's folder, and run the plan again.") from error
        return report


class ResultFolder:
    """Results below a folder, named by content; several processes may add the same one, and one of them is kept."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._results = root / "results"
        self._quarantine = root / QUARANTINE

    @property
    def lock(self) -> Path:
        """File whose lock the writing run holds."""
        return self.root / ".lock"

    def prepare(self, plan: Plan) -> None:
        """Make the folders and store the plan; remove what a killed run left incomplete.

        An earlier plan is moved to `earlier-plans`; results that both have stay. StoreError if it cannot be written.
        """
        for folder in (self._results, self._quarantine):
            write_or_raise(folder, partial(atomic_io.make_folder, folder, None))
        kept = self.root / PLAN
        if kept.is_file() and read_plan(kept) != plan:
            earlier = self.root / EARLIER_PLANS / f"{file_digest(kept)[:12]}.toml"
            write_or_raise(earlier, lambda: atomic_io.make_folder(earlier.parent, None))
            write_or_raise(earlier, lambda: atomic_io.replace_durably(kept, earlier))
        write_or_raise(kept, lambda: atomic_io.write_atomically(kept, encoded(plan), mode=None))
        for part in self._results.glob("*/.*.part"):
            shutil.rmtree(part, ignore_errors=True)

    def place(self, name: str) -> Path:
        """Return the folder of a result."""
        return self._results / name[:2] / name

    def has(self, name: str) -> bool:
        """Return whether a result is complete."""
        return (self.place(name) / REPORT).is_file()

    def add(self, name: str, files: Mapping[str, bytes]) -> None:
        """Store the files of a result atomically and durably; a result that is there already stays.

        OSError if the disk refuses; nothing incomplete has the name of a result then.
        """
        place = self.place(name)
        part = place.with_name(f".{name}.{uuid4().hex[:8]}.part")
        atomic_io.make_folder(place.parent, None)
        try:
            atomic_io.write_folder(part, files, private=False)
            if not place.is_dir():
                atomic_io.replace_durably(part, place)
        except OSError:
            if not self.has(name):  # else another worker was faster, and the rename found its result
                raise
        finally:
            shutil.rmtree(part, ignore_errors=True)

    def read(self, name: str) -> Stored:
        """Return the documents of a result; SettingError if one cannot be read."""
        report, run = (_document(self.place(name) / file) for file in (REPORT, RUN))
        return Stored(report, run)

    def quarantine(self, failure: Quarantined) -> None:
        """Store why a capture has no result; OSError if the disk refuses."""
        path = self._quarantine / f"{failure.name}.json"
        atomic_io.write_atomically(path, json.dumps(asdict(failure), indent=1).encode(), mode=None)

    def release(self, name: str) -> None:
        """Take a capture out of quarantine; no-op if it is not there."""
        (self._quarantine / f"{name}.json").unlink(missing_ok=True)

    def quarantined(self) -> Iterator[Quarantined]:
        """Yield every capture in quarantine, sorted by name."""
        for path in files_in(self._quarantine, "*.json"):
            entries = _document(path)
            yield Quarantined(**entries)


def encoded_document(value: object) -> bytes:
    """Return a JSON document of a result: sorted keys, so that equal values give equal bytes."""
    return (json.dumps(value, indent=1, sort_keys=True) + "\n").encode()


def _document(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise SettingError(
            f"{path} cannot be read: {error}", f"Remove {path.parent}, and run the plan again."
        ) from error
