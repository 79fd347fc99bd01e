"""Payloads of the server-sent events, by event name."""

from functools import reduce
from itertools import starmap
from operator import or_
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, create_model
from pydantic.dataclasses import dataclass

from device.recon.assessment.aiming import AimCode
from device.values import Verdict
from services.http.schemas.captures import CaptureAnswer
from services.http.schemas.common import ResponseBody
from services.http.schemas.problems import ErrorText
from services.http.schemas.status import AlertAnswer, FindingAnswer
from services.records.json_values import OmittedIfNone
from services.records.stored_record import CONFIG


class Heartbeat(ResponseBody):
    """Heartbeat, once per second; `number` of the latest event."""

    number: int


class InstrumentState(ResponseBody):
    """State of the exam: `starting`, `aim`, `busy` or `making`."""

    state: str


class AimingHint(ResponseBody):
    """Aiming hint, and the lit share of the field, 0 to 1."""

    code: AimCode
    fill: float


class CaptureProgress(ResponseBody):
    """Progress of a capture: stage, `fraction` done (0 to 1), seconds left, and the idempotency key of its request.

    `url`: URL of the quick look, or null. `visit`, `slot`: null for a test picture.
    """

    id: str
    stage: str
    fraction: float
    left_s: float
    url: str | None
    key: str | None
    visit: str | None
    slot: str | None


@dataclass(frozen=True, kw_only=True, config=CONFIG)
class CaptureVerdict(Verdict):
    """Verdict on the image quality of a capture."""

    id: str


class Failure(ErrorText):
    """An error; `id` is present if it ended a capture."""

    id: OmittedIfNone[str] = None


class AccuracyProgress(ResponseBody):
    """Progress text of the accuracy explorer; empty at the end."""

    progress: str


class AlertChange(AlertAnswer):
    """An alert that is active from now on, with its values, or ended (`over`)."""

    over: OmittedIfNone[bool] = None


class LeaseChange(ResponseBody):
    """Another screen has the control lease, or none has it (`over`)."""

    code: Literal["link.other"]
    over: bool


class CalibrationFindings(ResponseBody):
    """Findings of the calibration monitor, published when the set of failed ones changes."""

    findings: list[FindingAnswer]


class ButtonPress(ResponseBody):
    """Press of the button on the handle: the page that aims takes a picture."""


PAYLOADS = {
    "beat": Heartbeat,
    "state": InstrumentState,
    "aim": AimingHint,
    "button": ButtonPress,
    "stage": CaptureProgress,
    "verdict": CaptureVerdict,
    "kept": CaptureAnswer,
    "failed": Failure,
    "accuracy": AccuracyProgress,
    "notice": AlertChange | LeaseChange,
    "calibration": CalibrationFindings,
}


def _event(name: str, payload: Any) -> type[ResponseBody]:
    """Return the model of an event, such as StateEvent: its name as `event`, its payload as `data`."""
    # A dictionary, since mypy takes no Literal of a variable as an argument.
    fields: dict[str, Any] = {"event": Literal[name], "data": payload}
    return create_model(f"{name.capitalize()}Event", __base__=ResponseBody, __doc__=f"Event `{name}`.", **fields)


ServerSentEvent: Any = Annotated[reduce(or_, starmap(_event, PAYLOADS.items())), Field(discriminator="event")]
SERVER_SENT_EVENT: TypeAdapter[Any] = TypeAdapter(ServerSentEvent)
