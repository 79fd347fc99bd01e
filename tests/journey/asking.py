"""An instrument that can be asked what stands: equipped with what may fail, and what its server says of it."""

import secrets
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from device.calibration.archive import Provenance
from device.clock import VirtualClock
from device.head import Chips, Head
from device.sim.chips import SimBattery, SimThermometer
from device.spec import BusSpec
from services.instrument.bulletin import Bulletin
from tests.journey.conftest import Rig
from tests.receiver import Receiver

BUS = BusSpec(backend="sim", thermometer=0x48, battery=0x36)
MAKE_WEEKS = 10  # the calibration's age
MOST_BYTES = 10**12


@dataclass
class Shelf:
    """How much room the shelf believes it has, what it costs to ask, and who receives what is finished."""

    free_bytes: int = MOST_BYTES
    asked: Callable[[], None] = lambda: None
    receiver: Receiver = field(default_factory=Receiver)

    def __call__(self, folder: Path) -> int:
        self.asked()
        return self.free_bytes


class Attentive(Bulletin):
    """News at which something else happens: once, when a press begins."""

    at_the_press: Callable[[], None] | None = None

    def tell(self, kind: str, **data: Any) -> None:
        super().tell(kind, **data)
        if data.get("stage") == "expose" and self.at_the_press is not None:
            act, self.at_the_press = self.at_the_press, None
            act()


@dataclass(frozen=True)
class Said:
    """What the server said: by which way, its code, its numbers, and its remedy where it refused."""

    way: str
    code: str
    facts: dict[str, Any] = field(default_factory=dict)
    remedy: str = ""


def equipped(head: Head, now: datetime | None = None) -> Head:
    """The small head with a thermometer, a battery, and a calibration of ten weeks ago."""
    world = head.camera._world  # type: ignore[attr-defined]  # of the simulated camera
    made_at = (now or VirtualClock().wall()) - timedelta(weeks=MAKE_WEEKS)
    return replace(
        head, spec=head.spec.model_copy(update={"bus": BUS}), chips=Chips(SimThermometer(world), SimBattery(world)),
        provenance=Provenance("D-1", made_at, "a technician", "0.1.0"),
    )  # fmt: skip


def agreed_visit(rig: Rig, key: str | None = None) -> dict[str, Any]:
    """A new visit whose person agreed to pictures."""
    begun = rig.request("POST", "/api/visits", json={"key": key or secrets.token_hex(8)}).json()
    return answered(rig, begun["id"], "consent", "agreed")


def answered(rig: Rig, visit: str, field: str, value: Any) -> dict[str, Any]:
    """The visit after one answer was recorded."""
    order = {"key": secrets.token_hex(8), "field": field, "value": value}
    answer = rig.request("PATCH", f"/api/visits/{visit}", json=order)
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def pressed(rig: Rig, eye: str = "OD", **more: Any) -> Said:
    """The answer to a press: a refusal, or the verdict of the picture."""
    answer = rig.request("POST", "/api/captures", json={"eye": eye} | more)
    body = answer.json()
    if answer.status_code == 201:
        verdict = body["verdict"]
        return Said("verdict", verdict["code"] or "good", {"method": body["report"]["method"]})
    known = {name: value for name, value in body.items() if name not in ("code", "message", "remedy")}
    return Said(str(answer.status_code), body["code"], known, body["remedy"])


def aimed(rig: Rig) -> Said:
    """The problem that the status has while somebody aims."""
    for _ in range(200):
        rig.request("GET", "/api/preview?after=0&eye=OD")
        if (problem := rig.request("GET", "/api/status").json()["problem"]) is not None:
            known = {name: value for name, value in problem.items() if name not in ("code", "message", "remedy")}
            return Said("status", problem["code"], known, problem["remedy"])
    raise AssertionError("the status has no problem")


def live(rig: Rig, after: int, eye: str = "OD") -> int:
    """The number of the next live picture after number `after`."""
    for _ in range(20):
        answer = rig.request("GET", f"/api/preview?after={after}&eye={eye}")
        if answer.status_code == 200:
            return int(answer.headers["x-frame"])
    raise AssertionError("no live picture came")


def stands(rig: Rig, code: str) -> Said:
    """What stands in the status; and the same as news to the pages that are open."""
    before = rig.bulletin.last_number
    standing = {one.pop("code"): one for one in rig.request("GET", "/api/status").json()["standing"]}
    rig.app.state.notices.look()
    since = [event for event in rig.bulletin._events if event.number > before]
    news = [event.data for event in since if event.kind == "notice" and event.data["code"] == code]
    assert len(news) == 1, since
    assert code in standing, standing
    assert {"code": code} | standing[code] == news[0]
    return Said("notice", code, standing[code])
