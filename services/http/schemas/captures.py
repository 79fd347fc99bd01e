"""Bodies of the endpoints of captures."""

from collections.abc import Mapping
from typing import Self

from pydantic import Field, model_validator

from device.values import Eye
from services.http.schemas.common import (
    ID_PATTERN,
    KEY_PATTERN,
    IdempotentRequest,
    RequestBody,
    ResponseBody,
)
from services.records.capture import COLOUR, Capture, CaptureVersion, ShownReport, StoredVerdict
from services.records.json_values import OmittedIfNone, Timestamp


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
    report: ShownReport
    visit: str | None
    slot: str | None
    test: bool
    verdict: StoredVerdict | None
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
        report=report,
        visit=report.visit,
        slot=report.slot,
        test=report.test,
        verdict=report.verdict,
        files=capture.files,
        links=links,
        versions=[_version(version, capture.files, at) for version in report.versions] or None,
    )


def _version(version: CaptureVersion, files: Mapping[str, str], at: str) -> VersionAnswer:
    """Return a version of a capture whose files are below the URL `at`."""
    return VersionAnswer(
        number=version.number,
        result=version.result,
        at=version.at,
        method=version.method,
        software=version.software,
        picture=f"{at}/{version.picture}",
        colour=f"{at}/{version.colour}" if version.colour in files else None,
        report=f"{at}/{version.report}",
    )
