"""Bodies of the endpoints of the upload queue."""

from services.http.schemas.common import IdempotentRequest, RecordId, ResponseBody
from services.http.schemas.problems import ErrorText
from services.records.json_values import Timestamp


class UploadRetry(IdempotentRequest):
    """Request body: retry the upload of one visit (its id) at once; without `visit`, of every waiting visit."""

    visit: RecordId | None = None


class WaitingVisit(ResponseBody):
    """A visit in the upload queue: id, patient number, time of its finish, size, attempts, and the last error.

    `number`: null for a user who may not read visits. `failing_since`: time of the first failed attempt, or null.
    `stuck`: the visit needs help from a user.
    """

    visit: str
    number: str | None
    since: Timestamp
    size_bytes: int
    tries: int
    failing_since: Timestamp | None
    error: ErrorText | None
    stuck: bool


class QueueAnswer(ResponseBody):
    """The upload queue: today's uploaded visits, all waiting ones, seconds until the next try, and the first visits.

    `configured` is false, and the queue empty, if no receiver is set up.
    """

    configured: bool
    sent: int
    waiting: int
    next_try_s: float
    visits: list[WaitingVisit]
