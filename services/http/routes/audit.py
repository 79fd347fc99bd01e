"""Endpoint of the audit log, for administrators."""

from fastapi import APIRouter, Query

from services.errors import RecordNotFound
from services.http.schemas.audit import AuditAnswer
from services.records.audit_log import NEWEST_BYTES, AuditLog


def audit_router(audit_log: AuditLog | None) -> APIRouter:
    """Return the router of the audit log."""
    router = APIRouter()

    @router.get("/api/audit")
    def entries(
        limit: int = Query(100, ge=1, le=1000),
        user: str = Query("", max_length=40),
        action: str = Query("", max_length=40),
        record: str = Query("", max_length=128),
    ) -> AuditAnswer:
        """Return the newest entries of the audit log, the newest first, of one user, action or record, and their check.

        Entries and check are of the last NEWEST_BYTES (4 MB); `diffuscope audit verify` checks the whole log. 404 if
        this device keeps no audit log.
        """
        if audit_log is None:
            raise RecordNotFound("no audit log is kept", "Look at the event log for the reason.")
        found, newest = audit_log.check(NEWEST_BYTES), audit_log.entries(limit, user, action, record)
        return AuditAnswer(entries=newest, count=found.entries, problem=found.problem)

    return router
