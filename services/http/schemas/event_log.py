"""Bodies of the endpoints of the event log."""

from pydantic import Field

from services.health.event_log import LogEntry
from services.http.schemas.common import RequestBody, ResponseBody


class EventLogExport(RequestBody):
    """Request body: the USB drive that receives the copy, by the folder that the server listed."""

    folder: str = Field(max_length=400)


class LogEntryList(ResponseBody):
    """Entries of the event log, the newest first."""

    entries: list[LogEntry]
