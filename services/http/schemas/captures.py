"""Bodies of the endpoints of captures."""

from collections.abc import Mapping
from typing import Self, TypeVar

from pydantic import BaseModel, Field, JsonValue, model_validator

from device.values import Colour, Eye
from services.http.schemas.common import (
    ID_PATTERN,
    KEY_PATTERN,
    IdempotentRequest,
    Number,
    OmittedIfNone,
    RequestBody,
    ResponseBody,
    StoredPart,
    Timestamp,
)
from services.records.capture import (
    COLOUR,
    Capture,
    CaptureReport,
    CaptureVersion,
    EyeConfirmation,
    EyeCorrection,
    LateralityEstimate,
    PictureVerdict,
)
from services.records.json_values import JsonObject

Part = TypeVar("Part", bound=StoredPart)


class NewCapture(RequestBody):
    """Request body of `POST /api/captures`: the eye, the picture slot of a visit, and an idempotency key.

    Requests with the same `key` (16 hexadecimal digits) give one capture. `visit` and `slot` are given together, or
    neither for a test picture.
    """

    eye: Eye
    key: str | None = Field(default=None, pattern=KEY_PATTERN)
    visit: str | None = Field(default=None, pattern=ID_PATTERN)
    slot: str | None = Field(default=None, min_length=1, max_length=40)

    @model_validator(mode="after")
    def _both_or_neither(self) -> Self:
        if (self.visit is None) != (self.slot is None):
            raise ValueError("give both the visit and the slot, or neither")
        return self


class LateralityCorrection(IdempotentRequest):
    """Request body: the eye that a picture shows."""

    eye: Eye


class CaptureLinks(ResponseBody):
    """URLs of the files of a capture: `picture` is the one in green light, `colour` the one in colour, if any."""

    picture: str
    colour: OmittedIfNone[str] = None
    raw: str
    report: str
    quick: str


class VerdictAnswer(StoredPart):
    """Verdict on the image quality: `word` ("good" or "again"), code of the cause (null if good), measured figures."""

    word: str | None
    code: str | None
    numbers: dict[str, JsonValue]


class LateralityAnswer(StoredPart):
    """Estimate of the eye that a picture shows; `eye` is null if uncertain.

    `confidence`: 0 to 1; `disc`: row and column of the optic disc in the picture, or null.
    """

    eye: Eye | None
    confidence: Number
    disc: tuple[Number, Number] | None


class FrameAnswer(StoredPart):
    """What became of one frame of the burst: whether it is used, its shift (rows, cols; pixels), weight, and reason.

    File `raw.tiff` is the frame 0, `raw-1.tiff` the frame 1.
    """

    index: int
    used: bool
    shift_px: tuple[Number, Number] | None
    weight: Number
    reason: str | None


class ChannelAnswer(StoredPart):
    """One colour of light: its shift from green (rows, cols; pixels), whether it is predicted, not measured.

    `reason`: why the picture has not this colour, and `code` its name for programs; null for one that it has.
    `white_ratio`: its light over that of a white card; only with a white reference, else the hue is neutral. File
    `raw-red.tiff` is the raw frame of red.
    """

    name: Colour
    shift_px: tuple[Number, Number] | None
    predicted: bool
    reason: str | None
    white_ratio: OmittedIfNone[Number] = None
    code: OmittedIfNone[str] = None


class EyeCorrectionAnswer(StoredPart):
    """Move of a capture to the other eye: the eye and slot before, the eye after, time (ISO 8601), and screen."""

    from_eye: Eye
    from_slot: str
    eye: str | None
    at: str | None
    by: str | None


class EyeConfirmationAnswer(StoredPart):
    """Confirmation of the recorded eye: eye, time (ISO 8601), and screen."""

    eye: str | None
    at: str | None
    by: str | None


class ReportAnswer(StoredPart):
    """Report of a capture, with the keys of `report.json`: reconstruction, light, visit, verdict, laterality.

    `seconds`: durations by stage; `budget_s`: time budget. `psf_cylinder`: cylinder of the PSF of the picture and its
    predicted gain; only if the PSF has one. `refraction_scatter`: scatter of the refraction between the frames of a
    burst. `dose_j_per_cm2`: dose of this exposure; `dose_24h_j_per_cm2`: dose of each eye in 24 h; `dose_high`: eyes
    above the warning; `limits_unchecked`: light limits that were not compared with the purchased standard. `frames`:
    one entry per frame of the burst. `channels`: one entry per colour, also for one that could not be taken; not for a
    grey picture by design. `moved`: corrections of the eye, `confirmed`: its confirmation; both only where they exist.
    """

    method: str
    bin: int
    rounds: int
    stopped: str
    seconds: dict[str, Number]
    psf_index: int
    psf_scale: Number
    psf_cylinder: OmittedIfNone[dict[str, Number | None]] = None
    refraction_dpt: dict[str, Number | str | None] | None
    refraction_scatter: OmittedIfNone[dict[str, Number]] = None
    regularisation: dict[str, JsonValue]
    noise_dn: Number | None
    residual: Number | None
    quality: dict[str, JsonValue]
    warnings: list[str]
    frames: OmittedIfNone[list[FrameAnswer]] = None
    channels: OmittedIfNone[list[ChannelAnswer]] = None
    dose_j_per_cm2: Number | None
    dose_24h_j_per_cm2: dict[str, Number]
    dose_stop_j_per_cm2: Number | None
    dose_high: list[str]
    limits_unchecked: OmittedIfNone[list[str]] = None
    visit: str | None
    slot: str | None
    test: bool
    verdict: VerdictAnswer | None
    laterality: LateralityAnswer | None
    budget_s: Number
    moved: OmittedIfNone[list[EyeCorrectionAnswer]] = None
    confirmed: OmittedIfNone[EyeConfirmationAnswer] = None


class VersionAnswer(ResponseBody):
    """A later picture of a capture, made from its raw frames: number from 1, name of the result, and URLs of its files.

    `at`: time of the adoption (ISO 8601). `colour`: the picture in colour, if any.
    """

    number: int
    result: str
    at: str | None
    method: str | None
    software: str | None
    picture: str
    colour: OmittedIfNone[str] = None
    report: str


class CaptureAnswer(ResponseBody):
    """A stored capture: its eye, time, report and verdict, visit and slot, and its files with their SHA-256.

    `visit` and `slot` are null for a test picture (`test`). `versions`: later pictures, oldest first; only where there
    are some. `links` are always the files as taken.
    """

    id: str
    eye: Eye
    taken_at: Timestamp
    simulated: bool
    calibration_id: str
    report: ReportAnswer
    visit: str | None
    slot: str | None
    test: bool
    verdict: VerdictAnswer | None
    files: dict[str, str]
    links: CaptureLinks
    versions: OmittedIfNone[list[VersionAnswer]] = None


class CaptureList(ResponseBody):
    """Captures, the newest first."""

    captures: list[CaptureAnswer]


def capture_answer(capture: Capture) -> CaptureAnswer:
    """Return a capture with its report, its verdict and the URLs of its files."""
    at = f"/api/captures/{capture.id}"
    report = capture.report
    links = CaptureLinks(
        picture=f"{at}/picture.png",
        colour=f"{at}/{COLOUR}" if COLOUR in capture.files else None,
        raw=f"{at}/raw.tiff",
        report=f"{at}/report.json",
        quick=f"{at}/quick.jpg",
    )
    return CaptureAnswer(
        id=capture.id,
        eye=capture.eye,
        taken_at=capture.taken_at,
        simulated=capture.simulated,
        calibration_id=capture.calibration_id,
        report=report_answer(report),
        visit=report.visit,
        slot=report.slot,
        test=report.is_test,
        verdict=verdict_answer(report.verdict),
        files=capture.files,
        links=links,
        versions=[_version(one, capture.files, at) for one in report.versions] or None,
    )


def _version(one: CaptureVersion, files: Mapping[str, str], at: str) -> VersionAnswer:
    """Return a version of a capture whose files are below the URL `at`."""
    return VersionAnswer(
        number=one.number,
        result=one.result,
        at=one.at,
        method=one.method,
        software=one.software,
        picture=f"{at}/{one.picture}",
        colour=f"{at}/{one.colour}" if one.colour in files else None,
        report=f"{at}/{one.report}",
    )


def report_answer(report: CaptureReport) -> ReportAnswer:
    """Return the report of a capture.

    A stored entry whose type this release does not know has its default; other unknown entries are passed on.
    """
    entries = {
        **vars(report.reconstruction),
        **vars(report.light),
        "visit": report.visit,
        "slot": report.slot,
        "test": report.is_test,
        "budget_s": report.budget_s,
        "verdict": verdict_answer(report.verdict),
        "limits_unchecked": list(report.light.limits_unchecked) or None,
        "frames": [FrameAnswer.model_validate(vars(one)) for one in report.reconstruction.frames] or None,
        "channels": [ChannelAnswer.model_validate(vars(one)) for one in report.reconstruction.channels] or None,
        "laterality": _stored(LateralityAnswer, report.laterality) if report.laterality else None,
        "moved": [_stored(EyeCorrectionAnswer, one) for one in report.moved] or None,
        "confirmed": _stored(EyeConfirmationAnswer, report.confirmed) if report.confirmed else None,
    }
    return ReportAnswer.model_validate(_unknown(ReportAnswer, report.others) | entries)


def verdict_answer(verdict: PictureVerdict | None) -> VerdictAnswer | None:
    """Return a verdict; None for None."""
    return _stored(VerdictAnswer, verdict) if verdict else None


def _stored(model: type[Part], value: PictureVerdict | LateralityEstimate | EyeCorrection | EyeConfirmation) -> Part:
    """Return the model of a stored value, with those of its `others` that are no field of the model."""
    known = {name: entry for name, entry in vars(value).items() if name != "others"}
    return model.model_validate(_unknown(model, value.others) | known)


def _unknown(model: type[BaseModel], others: JsonObject) -> dict[str, JsonValue]:
    return {name: entry for name, entry in others.items() if name not in model.model_fields}
