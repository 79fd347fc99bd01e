"""Audit trail: the actions that enter the audit log, recorded before the answer of the request is sent."""

import logging
from collections.abc import Callable
from pathlib import Path

from starlette.concurrency import run_in_threadpool
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from device.clock import Clock
from device.errors import DiffuscopeError
from services.health.clock_source import clock_state
from services.records.audit_log import AuditLog

log = logging.getLogger(__name__)

VIEW, LIST_VISITS, LIST_PICTURES, LIST_USERS, READ_EVENT_LOG, HOLD_CAMERA = (
    "view",
    "list-visits",
    "list-pictures",
    "list-users",
    "read-event-log",
    "hold-camera",
)
# A page asks these again and again: one entry for each user and record in this time. What is refused, and all that an
# address without a login asks, has one for each action and status, since each entry is written with fsync.
REPEATED = {VIEW, LIST_VISITS, LIST_PICTURES, LIST_USERS, READ_EVENT_LOG, HOLD_CAMERA}
AGAIN_S = 300.0
RESET_ADMINISTRATOR = "reset-administrator"  # the set-up of a device with users
REFUSED = "refused"  # before access: a foreign host name or origin, or a body that is too large
REFUSED_STATUS = {400, 403, 422}
ACTIONS = {
    "POST /api/login": "sign-in",
    "DELETE /api/login": "sign-out",
    "POST /api/login/confirm": "confirm",
    "PUT /api/login/secret": "change-own-secret",
    "POST /api/setup": "set-up",
    "GET /api/users": LIST_USERS,
    "POST /api/users": "add-user",
    "PATCH /api/users/{name}": "change-user",
    "DELETE /api/users/{name}": "remove-user",
    "POST /api/ssh-keys": "decide-ssh-key",
    "POST /api/clock": "set-clock",
    "POST /api/clock/back": "set-clock-back",
    "POST /api/visits": "begin-visit",
    "GET /api/visits": LIST_VISITS,
    "GET /api/visits/{id}": VIEW,
    "GET /api/visits/{id}/changes": VIEW,
    "GET /api/visits/{id}/montage/{eye}": VIEW,
    "GET /api/visits/{id}/montage/{eye}/picture.png": VIEW,
    "PATCH /api/visits/{id}": "answer",
    "POST /api/visits/{id}/slots": "choose-picture",
    "POST /api/visits/{id}/not-possible": "not-possible",
    "POST /api/visits/{id}/finish": "finish",
    "POST /api/visits/{id}/reopen": "reopen",
    "GET /api/patients": "find-patient",
    "POST /api/patients/erase": "erase-patient",
    "POST /api/captures": "capture",
    "GET /api/captures": LIST_PICTURES,
    "GET /api/captures/{id}": VIEW,
    "GET /api/captures/{id}/{name}": VIEW,
    "GET /api/technician/captures/{id}/again.png": VIEW,
    "POST /api/captures/{id}/accept": "accept-picture",
    "POST /api/captures/{id}/eye": "change-eye",
    "GET /api/visits/{id}/export.zip": "export",
    "POST /api/visits/{id}/export": "export",
    "POST /api/calibration": "calibrate",
    "POST /api/calibration/cancel": "cancel-calibration",
    "POST /api/calibration/use": "use-calibration",
    "POST /api/calibration/trial-lenses": "calibrate",
    "POST /api/technician/accuracy": "measure-accuracy",
    "PUT /api/technician/pace": "set-time-budget",
    "POST /api/technician/backup": "backup",
    "POST /api/technician/backup/passphrase": "set-backup-passphrase",
    "POST /api/technician/removal": "remove-pictures",
    "POST /api/technician/removal/undo": "bring-back-pictures",
    "GET /api/technician/event-log": READ_EVENT_LOG,
    "GET /api/technician/event-log.txt": READ_EVENT_LOG,
    "POST /api/technician/event-log/export": "export-event-log",
    "POST /api/upload-queue/retry": "retry-upload",
    "POST /api/controller": HOLD_CAMERA,
    "POST /api/update/check": "look-for-update",
    "PUT /api/update/file": "bring-update",
    "POST /api/update/install": "update",
    "POST /api/update/restart": "restart",
    "GET /api/audit": "read-audit",
}
# Pages and states of the instrument, which name no patient; the next step of an action; a sign that the user is there.
UNRECORDED = frozenset(
    {
        "GET /",
        "GET /technician",
        "GET /web/{name:path}",
        "GET /api/login",
        "POST /api/login/activity",
        "GET /api/status",
        "GET /api/health",
        "GET /api/programme",
        "GET /api/ssh-keys",
        "GET /api/events",
        "GET /api/preview",
        "GET /api/exports",
        "GET /api/upload-queue",
        "GET /api/calibration",
        "POST /api/calibration/ready",
        "GET /api/calibration/preview",
        "POST /api/calibration/trial-lenses/ready",
        "GET /api/technician/accuracy",
        "GET /api/technician/accuracy.svg",
        "GET /api/technician/backup",
        "GET /api/technician/removal",
        "GET /api/update",
        "GET /api/openapi.json",
    }
)
Append = Callable[..., None]


class AuditTrail:
    """ASGI middleware that records the actions of `ACTIONS`, also refused ones, with user, record and HTTP status.

    With the source of the clock (clock_source.py), since the time of an entry is as good as that. `audit_log` None
    records nothing. `system`: root of the file system. A log that cannot be written is reported in the event log;
    requests go on.
    """

    def __init__(self, app: ASGIApp, audit_log: AuditLog | None, clock: Clock, system: Path) -> None:
        self.app, self._log, self._clock, self._system = app, audit_log, clock, system
        self._recorded_s: dict[tuple[str, ...], float] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one ASGI request to the application, and record its action before the answer begins."""

        async def send_recorded(message: Message) -> None:
            if message["type"] == "http.response.start":
                await self._record(scope, message["status"])
            await send(message)

        await self.app(scope, receive, send if self._log is None or scope["type"] != "http" else send_recorded)

    async def _record(self, scope: Scope, status: int) -> None:
        state = scope.get("state", {})
        action = state.get("audit_action") or ACTIONS.get(state.get("operation", ""))
        if "operation" not in state and status in REFUSED_STATUS:
            action = REFUSED
        if action is None or self._log is None:
            return
        user = state.get("user")
        name = state.get("audit_user") or ("" if user is None else user.name)
        parameters = scope.get("path_params", {})
        record = str(parameters.get("id") or parameters.get("name") or state.get("audit_record", ""))
        address = state.get("audit_address") or (scope.get("client") or ("",))[0]
        what = record if name and status < 400 else str(status)
        if (action in REPEATED or not name) and not self._is_new(name or address, action, what):
            return
        more = {"status": str(status), "field": state.get("audit_field", ""), "from": address}
        more |= {"patient": state.get("audit_patient", ""), "clock": clock_state(self._system)}
        try:
            await run_in_threadpool(self._log.append, name, action, record, **more)
        except (OSError, DiffuscopeError) as error:
            log.error("the audit log cannot be written: %s", error)

    def _is_new(self, *what: str) -> bool:
        """Return whether the same was not recorded within AGAIN_S."""
        now_s = self._clock.now_s()
        self._recorded_s = {key: at_s for key, at_s in self._recorded_s.items() if now_s - at_s < AGAIN_S}
        is_new = what not in self._recorded_s
        if is_new:
            self._recorded_s[what] = now_s
        return is_new
