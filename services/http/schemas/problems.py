"""Problem responses: the JSON body of every 4xx and 5xx answer, and errors inside other bodies."""

from services.http.schemas.common import PublicText, ResponseBody
from services.records.json_values import OmittedIfNone


class ErrorText(ResponseBody):
    """An error: stable error code, description, and the action for the user."""

    code: str
    message: PublicText
    remedy: PublicText


class ProblemResponse(ErrorText):
    """Problem response: the JSON body of every 4xx and 5xx answer.

    `code` is a stable error code, `message` describes the error, `remedy` the action for the user. `n` (minutes to
    wait) and `wait_s` (seconds to wait) are present where the error has them.
    """

    n: OmittedIfNone[int] = None
    wait_s: OmittedIfNone[float] = None
