"""Endpoints of the instrument's status and health."""

from importlib.metadata import version

from fastapi import APIRouter, Request

from device.head import kind_of
from device.recon.model.field_of_view import field_radius_px
from services.delivery.upload_worker import UploadWorker
from services.health.alert_monitor import AlertMonitor
from services.health.alerts import is_age_warning
from services.health.checks import picture_times, run_checks
from services.health.collector import collect_status
from services.http.access import may
from services.http.control_lease import ControlLease
from services.http.problem_responses import problem_body
from services.http.schemas.status import (
    AlertAnswer,
    CheckAnswer,
    FindingAnswer,
    HealthAnswer,
    PictureTimesAnswer,
    StatusAnswer,
)
from services.instrument.head_arbiter import HeadArbiter
from services.instrument.status import interrupted_captures, read_status, wait_until_dark
from services.records.visit_repository import VisitRepository

VERSION = version("diffuscope")


def status_router(
    arbiter: HeadArbiter,
    repository: VisitRepository,
    lease: ControlLease,
    alerts: AlertMonitor,
    upload_worker: UploadWorker | None,
) -> APIRouter:
    """Return the router of status and health."""
    router = APIRouter()

    @router.get("/api/status")
    def status(request: Request) -> StatusAnswer:
        """Return the status of the instrument.

        State, head, free space in captures and visits, holder of the control lease, active alerts, interrupted
        captures, and the counts of the upload queue. `problem` is the error that prevents captures now, or null.
        `notices`: remedies of the failed findings of the calibration monitor, without the age warning. Interrupted
        captures, and alerts with the id of a capture, are for users who may read captures.
        """
        answer = status_answer(arbiter, repository, lease, alerts, upload_worker)
        if may(request, "GET /api/captures/{id}"):
            return answer
        standing = [alert for alert in answer.standing if alert.id is None]
        return answer.model_copy(update={"swept": [], "standing": standing})

    @router.get("/api/health")
    def health() -> HealthAnswer:
        """Return every health check with its value, limit and remedy, and the findings of the calibration monitor.

        `ok` is true if all checks pass; `battery` is the charge from 0 to 1, or null.
        """
        is_dark = wait_until_dark(arbiter)
        now = read_status(arbiter)
        unsent = None if upload_worker is None else upload_worker.waiting_and_stuck()
        context = arbiter.context
        collected = collect_status(now, is_dark, context.store, repository, context.clock, unsent)
        checks = run_checks(collected)
        times = picture_times(collected.presses)
        return HealthAnswer(
            ok=all(check.ok for check in checks),
            state=collected.state,
            space_left=collected.captures_left,
            battery=collected.battery if isinstance(collected.battery, float) else None,
            checks=[CheckAnswer.model_validate(check) for check in checks],
            calibration=[FindingAnswer.model_validate(finding) for finding in arbiter.findings],
            times=None if times is None else PictureTimesAnswer.model_validate(times),
        )

    return router


def status_answer(
    arbiter: HeadArbiter,
    repository: VisitRepository,
    lease: ControlLease,
    alerts: AlertMonitor,
    upload_worker: UploadWorker | None,
) -> StatusAnswer:
    """Return the status of the instrument."""
    spec = arbiter.context.spec
    head = arbiter.head
    problem = arbiter.owner.problem
    store = arbiter.context.store
    radius_px = field_radius_px(head.calibration) if head is not None else float("inf")
    return StatusAnswer(
        name=spec.name,
        kind=kind_of(spec),
        state=arbiter.owner.state,
        shape=head.camera.shape if head is not None else (spec.camera.rows, spec.camera.cols),
        field_px=2 * radius_px if radius_px < float("inf") else None,
        version=VERSION,
        swept=interrupted_captures(arbiter, repository),
        space_left=store.space.captures_left(),
        people_left=store.space.visits_left(len(repository.programme.slots)),
        controller=lease.holder,
        problem=problem_body(problem) if problem else None,
        standing=[AlertAnswer.model_validate(alert) for alert in alerts.active_alerts()],
        sending=upload_worker.counts() if upload_worker is not None else None,
        last_capture_at=next((capture.taken_at for capture in store.captures(1)), None),
        notices=[finding.remedy for finding in arbiter.findings if not finding.ok and not is_age_warning(finding)],
    )
