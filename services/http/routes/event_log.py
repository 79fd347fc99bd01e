"""Endpoints of the event log: list entries, download them as text, copy them to a USB drive."""

from fastapi import APIRouter, Query

from device.clock import Clock
from services.delivery.usb_drives import UsbDrives, copy_to_drive
from services.health.event_log import EventLog
from services.http.media import TextResponse, file_responses
from services.http.schemas.common import FolderName
from services.http.schemas.event_log import EventLogExport, LogEntryList


def event_log_routes(event_log: EventLog, drives: UsbDrives, clock: Clock) -> APIRouter:
    """Return the router of the event log under /api/technician/event-log."""
    router = APIRouter(prefix="/api/technician")

    def name() -> str:
        return f"event-log-{clock.wall():%Y-%m-%d}"

    @router.get("/event-log")
    def entries(limit: int = Query(100, ge=1, le=1000), about: str | None = None) -> LogEntryList:
        """List entries of the event log, the newest first.

        At most `limit` entries; `about` restricts them to one capture id.
        """
        return LogEntryList(entries=event_log.entries(limit, about))

    @router.get("/event-log.txt", response_class=TextResponse, responses=file_responses("text/plain"))
    def download() -> TextResponse:
        """Return the whole event log as plain text, the oldest entry first."""
        headers = {"Content-Disposition": f'attachment; filename="{name()}.txt"'}
        return TextResponse(event_log.as_text(), headers=headers)

    @router.post("/event-log/export")
    def copy(away: EventLogExport) -> FolderName:
        """Copy the event log to a USB drive, as text and as JSON lines.

        Answers with the name of the new folder; 503 if the drive was removed, 507 if it is full.
        """
        files = {"event-log.txt": event_log.as_text(), "event-log.jsonl": event_log.as_jsonl()}
        return FolderName(folder=copy_to_drive(drives.mounted_folder(away.folder), name(), files).name)

    return router
