"""Record of one stored capture and its report: the keys of `report.json`, of the database JSON and of the wire."""

import dataclasses
from collections.abc import Mapping
from datetime import datetime
from typing import Any, Literal, Self

from pydantic import computed_field, field_validator
from pydantic.dataclasses import dataclass

from device.light_safety.dose_report import DoseReport
from device.values import OMITTED_IF_EMPTY, Eye, FrameUse, Number, Report, SimulatedEffects, Verdict, Whole
from services.records.stored_record import CONFIG, StoredRecord

NO_METHOD = "none"  # method in the report of a capture without a reconstruction
COLOUR = "colour.png"  # file of the picture in colour, which not every capture has
OtherColour = Literal["red", "blue", "amber"]  # of light, besides the green one of the picture
BUDGET_S = 5.0  # standard time budget, also of a report without one; defined in services/instrument/time_budget.py


@dataclass(frozen=True, config=CONFIG)
class StoredVerdict(StoredRecord, Verdict):
    """Verdict on the image quality of a stored picture."""

    CHECKED = frozenset({"word"})


@dataclass(frozen=True, config=CONFIG)
class LateralityEstimate(StoredRecord):
    """Estimate of the eye that the picture shows."""

    eye: Eye | None = None
    """OD (right) or OS (left); null if uncertain."""

    confidence: Number = 0.0
    """0 to 1."""

    disc: tuple[Number, Number] | None = None
    """Row and column of the optic disc in the picture, in pixels of the sensor."""


@dataclass(frozen=True, config=CONFIG)
class EyeConfirmation(StoredRecord):
    """Confirmation of the recorded eye."""

    eye: str | None = None
    """Eye that is confirmed: OD (right) or OS (left)."""

    at: str | None = None
    """Time, ISO 8601."""

    by: str | None = None
    """Public name of the screen; null for the instrument's own button or a script."""


@dataclass(frozen=True, config=CONFIG)
class EyeCorrection(StoredRecord):
    """Move of a capture to the other eye."""

    CHECKED = frozenset({"from_eye", "from_slot"})

    from_eye: Eye
    """Eye before the correction."""

    from_slot: str
    """Picture slot before the correction."""

    eye: str | None = None
    """Eye after the correction: OD (right) or OS (left)."""

    at: str | None = None
    """Time, ISO 8601."""

    by: str | None = None
    """Public name of the screen; null for the instrument's own button or a script."""


# Source of the date of a record: see services/health/clock_source.py; a browser is asked where nothing better is there.
ClockState = Literal["not_set", "browser", "rtc", "network"]


@dataclass(frozen=True, config=CONFIG)
class RecordOrigin(StoredRecord):
    """Device, software, head and calibration that made a record, and the source of its date."""

    uuid: str | None = None
    """UUID of the device, made with its data folder."""

    serial: str | None = None
    """Serial number of its board."""

    software: str | None = None
    """Version of the software."""

    head: str | None = None
    """Name of the head."""

    calibration_id: str | None = None
    """Identifier of the calibration."""

    calibrated_at: str | None = None
    """Date of the calibration, ISO 8601; null for a simulated one."""

    clock: str | None = None
    """Source of the date: network, rtc (clock of the board), browser (of a tablet), or not_set: it may be too early."""


@dataclass(frozen=True, config=CONFIG)
class CaptureVersion(StoredRecord):
    """A later picture of a capture, made from its raw frames by `diffuscope archive run` and adopted by the store."""

    CHECKED = frozenset({"number", "result"})

    number: Whole
    """1 for the first one; its files are picture-1.png, report-1.json and, in colour, colour-1.png."""

    result: str
    """Name of the result, a digest of frames, calibration, software and settings."""

    at: str | None = None
    """Time of the adoption, ISO 8601."""

    method: str | None = None
    """Method of the reconstruction."""

    software: str | None = None
    """Version of the program."""

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


@dataclass(frozen=True, config=CONFIG)
class ShownReport(StoredRecord, DoseReport, Report):
    """Report of a capture as endpoints return it: reconstruction, light, visit and slot, verdict, laterality, budget.

    Its entries are the keys of `report.json`. `seconds` include the exposure.
    """

    CHECKED = frozenset(
        {"seconds", "refraction_dpt", "dose_j_per_cm2", "visit", "slot", "verdict", "budget_s", "moved"}
    )
    COMPUTED = frozenset({"test"})

    method: str = NO_METHOD
    frames: tuple[FrameUse, ...] = dataclasses.field(default=(), metadata=OMITTED_IF_EMPTY)

    visit: str | None = None
    """Identifier of the visit; null for a test picture."""

    slot: str | None = None
    """Picture slot of the programme, for example R-centre; null for a test picture."""

    verdict: StoredVerdict | None = None
    """Verdict for the operator."""

    laterality: LateralityEstimate | None = None
    """Estimate of the eye that the picture shows."""

    budget_s: Number = BUDGET_S
    """Time budget of the picture in s, from the last read-out."""

    from_read_out_s: Number | None = dataclasses.field(default=None, metadata=OMITTED_IF_EMPTY)
    """Seconds from the last read-out (of a resumed press: the loaded frames) to the picture, without other work."""

    from_tap_s: Number | None = dataclasses.field(default=None, metadata=OMITTED_IF_EMPTY)
    """Seconds from the arrival of the request to the final picture; only if the picture is of the same run."""

    effects: SimulatedEffects | None = dataclasses.field(default=None, metadata=OMITTED_IF_EMPTY)
    """Effects that the simulator put into the picture; only of a simulated head."""

    moved: tuple[EyeCorrection, ...] = dataclasses.field(default=(), metadata=OMITTED_IF_EMPTY)
    """Corrections of the eye, oldest first; only if there are any."""

    confirmed: EyeConfirmation | None = dataclasses.field(default=None, metadata=OMITTED_IF_EMPTY)
    """Confirmation of the recorded eye; only if there is one."""

    @computed_field  # type: ignore[prop-decorator]  # mypy knows no decorator above a property
    @property
    def test(self) -> bool:
        """True for a test picture, which belongs to no visit."""
        return self.visit is None

    @field_validator("seconds", "dose_24h_j_per_cm2", "refraction_scatter", mode="before")
    @classmethod
    def _without_null(cls, value: object) -> object:
        """Return the numbers of an object: null is none."""
        if not isinstance(value, Mapping):
            return value
        return {name: number for name, number in value.items() if number is not None}

    @field_validator("refraction_dpt", mode="before")
    @classmethod
    def _refraction(cls, value: object) -> object:
        """Return the numbers and nulls of a refraction, its texts `zero` and `refused`; only `sphere` is checked."""
        if not isinstance(value, Mapping):
            return value
        if not _is_figure("sphere", value.get("sphere")):
            raise ValueError("sphere: neither a number nor null")
        return {name: figure for name, figure in value.items() if _is_figure(name, figure)}


@dataclass(frozen=True, config=CONFIG)
class CaptureReport(ShownReport):
    """Report of a capture as stored: with its origin, and the later versions of its picture."""

    device: RecordOrigin | None = dataclasses.field(default=None, metadata=OMITTED_IF_EMPTY)
    """Origin of the capture; null where it is unknown."""

    versions: tuple[CaptureVersion, ...] = dataclasses.field(default=(), metadata=OMITTED_IF_EMPTY)
    """Later pictures, oldest first; only if there are any."""

    def with_correction(self, slot: str, correction: EyeCorrection) -> Self:
        """Return a copy of the report with a new slot and one more correction of the eye."""
        return self._with(slot=slot, moved=(*self.moved, correction))

    def with_confirmation(self, confirmation: EyeConfirmation) -> Self:
        """Return a copy of the report with this confirmation of the recorded eye."""
        return self._with(confirmed=confirmation)

    def with_version(self, version: CaptureVersion) -> Self:
        """Return a copy of the report with one more version of the picture."""
        return self._with(versions=(*self.versions, version))

    def _with(self, **changed: Any) -> Self:
        others = {name: value for name, value in self.others.items() if name not in changed}
        return dataclasses.replace(self, **changed, others=others)


def _is_figure(name: str, value: object) -> bool:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return value is None or is_number or (name in ("refused", "zero") and isinstance(value, str))


@dataclasses.dataclass(frozen=True)
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
        return dataclasses.replace(self, files=files)
