"""Bodies of the endpoint of the audit log."""

from services.http.schemas.common import ResponseBody


class AuditEntryAnswer(ResponseBody):
    """One entry: number, UTC time, user, action, id of the record, and further values such as the HTTP status."""

    number: int
    at: str
    user: str
    action: str
    record: str
    more: dict[str, str]


class AuditAnswer(ResponseBody):
    """Entries, the number of valid ones in the part that was checked, and its problem; null without one."""

    entries: list[AuditEntryAnswer]
    count: int
    problem: str | None
