"""Bodies of the endpoints of visits and of the control lease."""

from typing import Literal

from pydantic import Field

from services.http.schemas.common import IdempotentRequest, RecordId, ResponseBody, SlotName
from services.http.schemas.problems import ErrorText
from services.instrument.visit_montage import MontageState
from services.records.json_values import FormValue
from services.records.visit import ReopenReason
from services.records.visit_document import VisitDocument


class NewVisit(IdempotentRequest):
    """Request body: a new visit of a patient by number; null takes the next automatic number."""

    number: str | None = Field(default=None, min_length=1, max_length=40)


class FieldValue(IdempotentRequest):
    """Request body: the value of one form field; null clears it."""

    field: str = Field(min_length=1, max_length=40)
    value: FormValue


class MissingPicture(IdempotentRequest):
    """Request body: a picture that could not be taken, and the reason."""

    slot: SlotName
    reason: str = Field(min_length=1, max_length=40)


class SlotChoice(IdempotentRequest):
    """Request body: the capture that fills a picture slot; null empties the slot."""

    slot: SlotName
    capture: RecordId | None


class Reopening(IdempotentRequest):
    """Request body: why a finished visit is opened again."""

    reason: ReopenReason


class ControlRequest(IdempotentRequest):
    """Request body of the control lease; `key` is the secret key of the screen.

    `take` takes the lease from another screen, `release` lets it expire.
    """

    take: bool = False
    release: bool = False


class LeaseAnswer(ResponseBody):
    """State of the control lease: public name of its present or last holder, and whether this screen holds it."""

    lease: str | None
    mine: bool


class VisitCounts(ResponseBody):
    """Numbers of finished (`done`) and unfinished (`to_finish`) visits; of `done`, those `referred` and `declined`."""

    done: int
    to_finish: int
    referred: int
    declined: int


class VisitList(ResponseBody):
    """Visits, the newest first, with the counts of the day, or of all days."""

    visits: list[VisitDocument]
    counts: VisitCounts


class PlacedPicture(ResponseBody):
    """Place of a picture in a montage: what is at (row, column) of the first picture is at that place + `shift_px`.

    `rotation_deg`: counter-clockwise as displayed, about the picture's centre. `peak`: correlation with the picture to
    which it was registered, `overlap` their common part of the smaller field; null for the first. `reason`: why it is
    not used.
    """

    index: int
    slot: str
    capture: str
    used: bool
    shift_px: tuple[float, float] | None
    rotation_deg: float | None
    peak: float | None
    overlap: float | None
    reason: str | None


class MontageAnswer(ResponseBody):
    """Montage of the chosen pictures of one eye.

    `state`: `none` with fewer than two pictures, `computing` until it is known (it waits while the camera is used),
    `joined`, `apart` if no two pictures could be joined, `failed` with `problem`. `digest`: names the set of pictures.
    `pictures`: their number. `placed`: the place of each, empty before it is known. `projection`: of the places,
    "sphere", or "plane" if the scale of the pictures is unknown; null before it is known.
    """

    state: MontageState
    digest: str
    pictures: int
    placed: list[PlacedPicture]
    projection: Literal["sphere", "plane"] | None
    problem: ErrorText | None
