"""Endpoints of the administrator that erase a patient."""

from typing import Annotated

from fastapi import APIRouter, Query, Request

from services.backup.backup_runner import BackupRunner
from services.errors import Busy
from services.http.schemas.erasure import ErasureRequest, PatientCounts
from services.instrument.head_arbiter import HeadArbiter
from services.records.erasure import ErasureReceipt


def erasure_routes(arbiter: HeadArbiter, backups: BackupRunner) -> APIRouter:
    """Return the router of the erasure of patients under /api/patients."""
    router = APIRouter(prefix="/api/patients")
    erasures, clock = arbiter.context.store.erasures, arbiter.context.clock

    @router.get("")
    def records(number: Annotated[str, Query(min_length=1, max_length=40)]) -> PatientCounts:
        """Return how much is stored of the patient with a number; 404 for an unknown one, 422 if it is none."""
        found = erasures.find(number)
        return PatientCounts(visits=len(found.visits), captures=len(found.captures), files=found.files)

    @router.post("/erase")
    def erase(order: ErasureRequest, request: Request) -> ErasureReceipt:
        """Erase a patient for good; answers with the receipt, which has no name and no number.

        404 for an unknown number, 409 while the camera is used or a backup is under way, which would keep the key.
        """
        request.state.audit_field = order.reason
        if not arbiter.is_idle:
            raise Busy("the camera is in use", "Wait until no picture is being taken, then repeat it.")
        if backups.state().progress is not None:
            raise Busy("a backup is under way", "Wait until it has ended, then repeat it.")
        request.state.audit_record, receipt = erasures.erase(order.number, order.reason, clock.wall())
        return receipt

    return router
