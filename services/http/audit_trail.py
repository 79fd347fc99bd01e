"""Audit trail: the actions that enter the audit log, recorded before the answer of the request is sent."""

import logging
from pathlib import Path

from starlette.concurrency import run_in_threadpool
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from device.clock import Clock
from device.errors import DiffuscopeError
from services.health.clock_source import clock_state
from services.http.access import OPERATIONS
from services.records.audit_log import AuditLog

log = logging.getLogger(__name__)

# A page asks these again and again: one entry for each user and record in this time. What is refused, and all that an
# address without a login asks, has one for each action and status, since each entry is written with fsync.
REPEATED = {"view", "list-visits", "list-pictures", "list-users", "read-event-log", "hold-camera"}
AGAIN_S = 300.0
RESET_ADMINISTRATOR = "reset-administrator"  # the set-up of a device with users
REFUSED = "refused"  # before access: a foreign host name or origin, or a body that is too large
REFUSED_STATUS = {400, 403, 422}


class AuditTrail:
    """ASGI middleware that records the actions of `OPERATIONS`, also refused ones, with user, record and HTTP status.

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
        action = state.get("audit_action") or OPERATIONS.get(state.get("operation"), (None, None))[1]
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
