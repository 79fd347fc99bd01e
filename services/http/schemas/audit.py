"""Bodies of the endpoint of the audit log."""

from services.http.schemas.common import ResponseBody
from services.records.audit_log import AuditEntry


class AuditAnswer(ResponseBody):
    """Entries, the number of valid ones in the part that was checked, and its problem; null without one."""

    entries: list[AuditEntry]
    count: int
    problem: str | None
