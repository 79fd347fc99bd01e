"""Record of one stored capture and its report, as frozen values; their JSON is in capture_report.py."""

from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Literal, Self

from device.light_safety.dose_report import DoseReport
from device.values import Eye, Report
from services.records.json_values import JsonObject

NO_METHOD = "none"  # method in the report of a capture without a reconstruction
COLOUR = "colour.png"  # file of the picture in colour, which not every capture has
OtherColour = Literal["red", "blue", "amber"]  # of light, besides the green one of the picture
BUDGET_S = 5.0  # standard time budget, also of a report without one


@dataclass(frozen=True)
class PictureVerdict:
    """Stored verdict on a picture: `word` ("good" or "again"), `code` of the cause (None if good), and the figures.

    `others`: entries of the stored JSON that this release does not read; they are written again unchanged.
    """

    word: str | None = None
    code: str | None = None
    numbers: JsonObject = field(default_factory=dict)
    others: JsonObject = field(default_factory=dict)

    @property
    def is_good(self) -> bool:
        """Return whether the picture is good."""
        return self.word == "good"


@dataclass(frozen=True)
class LateralityEstimate:
    """Stored estimate of the eye that a picture shows; `eye` is None if uncertain.

    `confidence`: 0 to 1; `disc`: (row, col) of the optic disc in the picture, None without an eye. `others`: as in
    PictureVerdict.
    """

    eye: Eye | None = None
    confidence: float = 0.0
    disc: tuple[float, float] | None = None
    others: JsonObject = field(default_factory=dict)


@dataclass(frozen=True)
class EyeCorrection:
    """Move of a capture from the eye and slot that it was taken for to `eye`.

    `at`: time (ISO 8601); `by`: public name of the screen that requested the move, None for the instrument's own button
    or a script. `others`: as in PictureVerdict.
    """

    from_eye: Eye
    from_slot: str
    eye: str | None = None
    at: str | None = None
    by: str | None = None
    others: JsonObject = field(default_factory=dict)


@dataclass(frozen=True)
class EyeConfirmation:
    """Confirmation that the recorded eye of a capture is correct; fields as in EyeCorrection."""

    eye: str | None = None
    at: str | None = None
    by: str | None = None
    others: JsonObject = field(default_factory=dict)


# Source of the date of a record: see services/health/clock_source.py; a browser is asked where nothing better is there.
ClockState = Literal["not_set", "browser", "rtc", "network"]


@dataclass(frozen=True)
class RecordOrigin:
    """Device, software, head and calibration that made a record, and the source of its date.

    `uuid`, `serial`: of the device. `calibrated_at`: date of the calibration (ISO 8601); None for a simulated one.
    `clock`: a ClockState, also one of a later release. `others`: as in PictureVerdict.
    """

    uuid: str | None = None
    serial: str | None = None
    software: str | None = None
    head: str | None = None
    calibration_id: str | None = None
    calibrated_at: str | None = None
    clock: str | None = None
    others: JsonObject = field(default_factory=dict)


@dataclass(frozen=True)
class CaptureVersion:
    """A later picture of a capture, made from its raw frames by `diffuscope archive run` and adopted by the store.

    `number` is 1 for the first one; its files are `picture-<number>.png`, `report-<number>.json` and, in colour,
    `colour-<number>.png`. `result`: name of the result, a digest of frames, calibration, software and settings. `at`:
    time of the adoption (ISO 8601); `method`: of the reconstruction; `software`: version of the program. `others`: as
    in PictureVerdict.
    """

    number: int
    result: str
    at: str | None = None
    method: str | None = None
    software: str | None = None
    others: JsonObject = field(default_factory=dict)

    @property
    def picture(self) -> str:
        """Name of the file of the picture."""
        return f"picture-{self.number}.png"

    @property
    def colour(self) -> str:
        """Name of the file of the picture in colour, which not every version has."""
        return f"colour-{self.number}.png"

    @property
    def report(self) -> str:
        """Name of the file of the report."""
        return f"report-{self.number}.json"


@dataclass(frozen=True)
class CaptureReport:
    """Report of a capture: its reconstruction, light, visit and slot, verdict, laterality and time budget.

    `reconstruction.seconds`: durations by stage, with the exposure. `visit` and `slot`: ids, None for a test picture.
    `moved`: corrections of the eye, oldest first; `confirmed`: None unless the recorded eye was confirmed. `device`:
    origin, None where it is unknown. `versions`: later pictures, oldest first. `others`: entries of the
    stored JSON that this release does not read or that have another type; they are written again unchanged. A field
    that is missing in the stored report has its default.
    """

    reconstruction: Report = field(default_factory=lambda: Report(NO_METHOD, frames=()))
    light: DoseReport = field(default_factory=DoseReport)
    visit: str | None = None
    slot: str | None = None
    verdict: PictureVerdict | None = None
    laterality: LateralityEstimate | None = None
    budget_s: float = BUDGET_S
    moved: tuple[EyeCorrection, ...] = ()
    confirmed: EyeConfirmation | None = None
    device: RecordOrigin | None = None
    versions: tuple[CaptureVersion, ...] = ()
    others: JsonObject = field(default_factory=dict)

    @property
    def is_test(self) -> bool:
        """Return whether the capture is a test picture: it belongs to no visit."""
        return self.visit is None

    @property
    def total_s(self) -> float:
        """Return the sum of the durations of all stages in s; 0 without any."""
        return float(sum(self.reconstruction.seconds.values()))

    def with_correction(self, slot: str, correction: EyeCorrection) -> Self:
        """Return a copy of the report with a new slot and one more correction of the eye."""
        return replace(self, slot=slot, moved=(*self.moved, correction), others=_without(self.others, "slot", "moved"))

    def with_confirmation(self, confirmation: EyeConfirmation) -> Self:
        """Return a copy of the report with this confirmation of the recorded eye."""
        return replace(self, confirmed=confirmation, others=_without(self.others, "confirmed"))

    def with_version(self, version: CaptureVersion) -> Self:
        """Return a copy of the report with one more version of the picture."""
        versions = (*self.versions, version)
        return replace(self, versions=versions, others=_without(self.others, "versions"))


def _without(entries: JsonObject, *names: str) -> JsonObject:
    return {name: value for name, value in entries.items() if name not in names}


@dataclass(frozen=True)
class Capture:
    """Record of one stored capture: id, eye, time, report, and the SHA-256 of each stored file by file name."""

    id: str
    eye: Eye
    taken_at: datetime
    simulated: bool
    calibration_id: str
    report: CaptureReport
    files: dict[str, str]

    @classmethod
    def new_id(cls, taken_at: datetime, eye: Eye, token: str) -> str:
        """Return a capture id `YYYYMMDDTHHMMSS-EYE-TOKEN`, which sorts by time; the caller gives a unique token."""
        return f"{taken_at:%Y%m%dT%H%M%S}-{eye}-{token}"

    def with_files(self, files: dict[str, str]) -> Self:
        """Return a copy of the capture with `files`, the SHA-256 of each stored file by file name."""
        return replace(self, files=files)
