"""Bodies of the endpoints of status and health, and of the alerts in the event stream."""

from typing import Annotated

from pydantic import PlainSerializer

from device.values import Eye
from services.delivery.upload_worker import UploadCounts
from services.health.alerts import AlertCode
from services.http.schemas.common import PublicText, ResponseBody
from services.http.schemas.problems import ProblemResponse
from services.records.capture_journal import InterruptedCapture
from services.records.json_values import OmittedIfNone, Timestamp

SignificantDigits = Annotated[float, PlainSerializer(lambda number: float(f"{number:.4g}"), return_type=float)]


class AlertAnswer(ResponseBody):
    """An active alert: its code, and those values that its text needs.

    `n`: a number of visits or days; `date`: ISO 8601; `wait_s`: seconds to wait; `id`, `slot`, `other`: a capture, its
    slot and the other eye.
    """

    code: AlertCode
    n: OmittedIfNone[int] = None
    date: OmittedIfNone[str] = None
    wait_s: OmittedIfNone[float] = None
    id: OmittedIfNone[str] = None
    slot: OmittedIfNone[str] = None
    other: OmittedIfNone[Eye] = None


class StatusAnswer(ResponseBody):
    """Status of the instrument: head, state, free space in captures (`space_left`) and visits (`people_left`), alerts.

    `shape`: rows and columns of the sensor. `field_px`: diameter of the lit field, or null. `swept`: interrupted
    captures. `controller`: public name of the screen with the control lease, or null. `problem`: error that prevents
    captures now, or null. `standing`: active alerts. `sending`: counts of the upload queue; null if upload is not set
    up. `notices`: remedies of the failed findings of the calibration monitor, without the age warning.
    `last_capture_at`: time of the newest picture, or null.
    """

    name: str
    kind: str
    state: str
    shape: tuple[int, int]
    field_px: float | None
    version: str
    swept: list[InterruptedCapture]
    space_left: int
    people_left: int
    controller: str | None
    problem: ProblemResponse | None
    standing: list[AlertAnswer]
    sending: UploadCounts | None
    notices: list[str]
    last_capture_at: Timestamp | None


class CheckAnswer(ResponseBody):
    """Result of one health check: value, limit and remedy as texts; `known`: there were data for it.

    `of_release`: the release of the software may be the cause of a failure.
    """

    name: str
    ok: bool
    value: PublicText
    limit: str
    remedy: PublicText
    of_release: bool
    known: bool


class FindingAnswer(ResponseBody):
    """One finding of the calibration monitor; `hint`: pictures remain valid although the limit is exceeded."""

    name: str
    ok: bool
    hint: bool
    value: SignificantDigits
    limit: SignificantDigits
    unit: str
    remedy: str


class PercentilesAnswer(ResponseBody):
    """50th and 99th percentile of a time, seconds."""

    p50_s: SignificantDigits
    p99_s: SignificantDigits


class PictureTimesAnswer(ResponseBody):
    """Times of the last 100 pictures: from the last read-out, from the tap, and over the budget (negative: in time).

    `missed`: pictures that were later than their time budget by more than 5 %.
    """

    pictures: int
    missed: int
    from_read_out: PercentilesAnswer
    from_tap: PercentilesAnswer
    late: PercentilesAnswer


class HealthAnswer(ResponseBody):
    """Every health check, the findings of the calibration monitor, and the times of the last pictures.

    `ok` is true if all checks pass; `battery` is the charge from 0 to 1, or null; `times` is null without pictures.
    """

    ok: bool
    state: str
    space_left: int
    battery: float | None
    checks: list[CheckAnswer]
    calibration: list[FindingAnswer]
    times: PictureTimesAnswer | None
