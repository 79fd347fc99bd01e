"""Bodies of the clock's endpoints."""

from pydantic import AwareDatetime

from services.http.schemas.common import IdempotentRequest, ResponseBody
from services.records.json_values import Timestamp


class ClockTime(IdempotentRequest):
    """Time of a tablet, with its time zone; a request that is repeated has no further effect."""

    now: AwareDatetime


class ClockAnswer(ResponseBody):
    """Times of the device before, and as requested: `systemd/diffuscope-clock.service` sets it at once."""

    was: Timestamp
    now: Timestamp
