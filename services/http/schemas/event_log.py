"""Bodies of the endpoints of the event log."""

from pydantic import Field

from services.http.schemas.common import RequestBody, ResponseBody


class EventLogExport(RequestBody):
    """Request body: the USB drive that receives the copy, by the folder that the server listed."""

    folder: str = Field(max_length=400)


class LogEntryAnswer(ResponseBody):
    """One entry: time (ISO 8601, UTC), level (lower case), text, code of an error, capture or visit id, traceback."""

    at: str
    level: str
    text: str
    code: str | None
    about: str | None
    detail: str | None


class LogEntryList(ResponseBody):
    """Entries of the event log, the newest first."""

    entries: list[LogEntryAnswer]
