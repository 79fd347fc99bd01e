"""Requests to a simulated instrument with all optional hardware, and the observed responses and alerts."""

import asyncio
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from device.calibration.archive import Provenance
from device.clock import VirtualClock
from device.config.head_file import BusSpec
from device.head import Head
from device.ports import Chips
from device.sim.camera import SimCamera
from device.sim.chips import SimBattery, SimThermometer
from services.instrument.capture import NO_VISIT, LiveRequest, Preview
from services.instrument.events import EventBus
from services.instrument.exam import ExamService
from tests.journey.conftest import Rig
from tests.receiver import Receiver

BUS = BusSpec(backend="sim", thermometer=0x48, battery=0x36)
MAKE_WEEKS = 10  # age of the calibration
MAX_BYTES = 10**12


def live_picture(exam: ExamService, after: int, wait_s: float = 2.0, wanted: LiveRequest = NO_VISIT) -> Preview | None:
    """Return the next live picture as the server's event loop does; for a thread without such a loop."""
    return asyncio.run(exam.preview(after, wait_s, wanted))


@dataclass
class DiskStub:
    """Stub of the disk (free bytes, delay hook `on_query`) and the receiver of finished visits."""

    free_bytes: int = MAX_BYTES
    on_query: Callable[[], None] = lambda: None
    receiver: Receiver = field(default_factory=Receiver)

    def __call__(self, folder: Path) -> int:
        self.on_query()
        return self.free_bytes


class PressHookBus(EventBus):
    """Event bus that calls `on_press` once, at the first stage event of a press."""

    on_press: Callable[[], None] | None = None

    def publish(self, kind: str, **data: Any) -> None:
        super().publish(kind, **data)
        if data.get("stage") == "expose" and self.on_press is not None:
            action, self.on_press = self.on_press, None
            action()


@dataclass(frozen=True)
class Observation:
    """Observed response: channel (verdict, notice, status or HTTP status), code, data, and remedy of a refusal."""

    way: str
    code: str
    facts: dict[str, Any] = field(default_factory=dict)
    remedy: str = ""


def with_all_chips(head: Head, now: datetime | None = None) -> Head:
    """Return the small head with a thermometer, a battery and a calibration that is ten weeks old."""
    assert isinstance(head.camera, SimCamera)
    world = head.camera.world
    made_at = (now or VirtualClock().wall()) - timedelta(weeks=MAKE_WEEKS)
    return replace(
        head,
        spec=head.spec.model_copy(update={"bus": BUS}),
        chips=Chips(SimThermometer(world), SimBattery(world)),
        provenance=Provenance("D-1", made_at, "a technician", "0.1.0"),
    )


def visit_with_consent(rig: Rig, key: str | None = None) -> dict[str, Any]:
    """Start a visit with recorded consent and return it."""
    visit = rig.request("POST", "/api/visits", json={"key": key or secrets.token_hex(8)}).json()
    return record_answer(rig, visit["id"], "consent", "agreed")


def record_answer(rig: Rig, visit: str, field: str, value: Any) -> dict[str, Any]:
    """Record one form field and return the visit."""
    body = {"key": secrets.token_hex(8), "field": field, "value": value}
    answer = rig.request("PATCH", f"/api/visits/{visit}", json=body)
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def post_capture(rig: Rig, eye: str = "OD", **more: Any) -> Observation:
    """Post a capture request; return the verdict of the capture or the refusal."""
    answer = rig.request("POST", "/api/captures", json={"eye": eye} | more)
    body = answer.json()
    if answer.status_code == 201:
        verdict = body["verdict"]
        return Observation("verdict", verdict["code"] or "good", {"method": body["report"]["method"]})
    facts = {name: value for name, value in body.items() if name not in ("code", "message", "remedy")}
    return Observation(str(answer.status_code), body["code"], facts, body["remedy"])


def status_problem(rig: Rig) -> Observation:
    """Request live pictures until the status reports a problem; return the problem."""
    for _ in range(200):
        rig.request("GET", "/api/preview?after=0&eye=OD")
        if (problem := rig.request("GET", "/api/status").json()["problem"]) is not None:
            facts = {name: value for name, value in problem.items() if name not in ("code", "message", "remedy")}
            return Observation("status", problem["code"], facts, problem["remedy"])
    raise AssertionError("the status has no problem")


def next_preview(rig: Rig, after: int, eye: str = "OD") -> int:
    """Return the number of the next live picture with a number above `after`."""
    for _ in range(20):
        answer = rig.request("GET", f"/api/preview?after={after}&eye={eye}")
        if answer.status_code == 200:
            return int(answer.headers["x-frame"])
    raise AssertionError("no live picture arrived")


def active_alert(rig: Rig, code: str) -> Observation:
    """Return the active alert `code` of the status; assert that the event bus published the same alert."""
    before = rig.event_bus.last_number
    alerts = {alert.pop("code"): alert for alert in rig.request("GET", "/api/status").json()["standing"]}
    rig.application.alerts.publish_changes()
    since = [event for event in rig.event_bus.history if event.number > before]
    news = [event.data for event in since if event.kind == "notice" and event.data["code"] == code]
    assert len(news) == 1, since
    assert code in alerts, alerts
    assert {"code": code} | alerts[code] == news[0]
    return Observation("notice", code, alerts[code])
