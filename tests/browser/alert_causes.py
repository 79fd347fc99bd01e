"""Causes of the alerts of the exam page at a real instrument: how each begins and ends."""

import secrets
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from datetime import timedelta
from pathlib import Path

from playwright.sync_api import Page, expect

from device.errors import LightLimit
from device.light_safety.dose_ledger import Reserved
from device.values import BatteryState
from services.instrument.live_pictures import RETRY_S
from tests.browser.real import Instruments, Real, Uncalibrated, copy_store
from tests.browser.upload_queue import queued
from tests.browser.walk import visit_of
from tests.journey.asking import MAX_BYTES
from tests.journey.conftest import until

NORMAL_C, CHARGED = 25.0, BatteryState(0.775, 3.88)
End = Callable[[], None]
Cause = Callable[[Real, str], End]  # of an instrument and a visit: cause the alert, return the function that ends it


def fault(name: str) -> Cause:
    """Return the cause of an alert that a fault of the head brings about, at the next live picture."""

    def begin(real: Real, visit: str) -> End:
        real.rig.world.faults.add(name)

        def end() -> None:
            real.rig.world.faults.discard(name)
            real.clock.advance(RETRY_S)

        return end

    return begin


def reading(change: Callable[[Real], None], restore: Callable[[Real], None]) -> Cause:
    """Return the cause of an alert that the monitor of the alerts reads."""

    def begin(real: Real, visit: str) -> End:
        change(real)
        real.publish_alerts()

        def end() -> None:
            restore(real)
            real.publish_alerts()

        return end

    return begin


def temperature(celsius: float) -> Cause:
    def change(real: Real, value: float) -> None:
        real.rig.world.temperature_c = value

    return reading(lambda real: change(real, celsius), lambda real: change(real, NORMAL_C))


def charge(fraction: float) -> Cause:
    def change(real: Real, value: BatteryState) -> None:
        real.rig.world.battery_state = value

    return reading(lambda real: change(real, BatteryState(fraction, 3.5)), lambda real: change(real, CHARGED))


def free_space(size_bytes: int) -> Cause:
    def change(real: Real, value: int) -> None:
        real.free_space.free_bytes = value

    return reading(lambda real: change(real, size_bytes), lambda real: change(real, MAX_BYTES))


def date(days: int) -> Cause:
    def change(real: Real, value: int) -> None:
        real.clock.moved = timedelta(days=value)

    return reading(lambda real: change(real, days), lambda real: change(real, 0))


def clock_folder(real: Real) -> Path:
    """Return the folder in which a device leaves the time of a tablet, if it has no other."""
    return real.rig.store.folder.parent / "system/run/diffuscope-clock"


def dose(ago_s: float) -> Cause:
    """Return the cause of an alert of the light limit: the right eye got the dose of a day some time ago."""

    def begin(real: Real, visit: str) -> End:
        light = real.rig.exam.head.light
        limit = light.hazard.limits.stop_j_per_cm2
        given: list[Reserved] = []

        def spend_rest() -> None:
            """Spend what is left of the dose; a live picture may have taken its part meanwhile."""
            with suppress(LightLimit):
                rest = limit - light.ledger.spent_j_per_cm2("OD")
                given.append(light.ledger.reserve(("OD",), (1 - 1e-6) * rest, limit))

        real.wait_for_problem("light.day", before_each=spend_rest)  # until no live picture with light is left
        real.clock.advance(ago_s)

        def end() -> None:
            for reservation in given:
                light.ledger.settle(reservation, 0.0)
            real.clock.advance(RETRY_S)

        return end

    return begin


def other_screen(real: Real, visit: str) -> End:
    key = secrets.token_hex(8)
    real.request("POST", "/api/controller", key=key, take=True)
    real.publish_alerts()

    def end() -> None:
        real.request("POST", "/api/controller", key=key, release=True)
        real.clock.advance(3.0)
        real.publish_alerts()

    return end


def consent(value: str | None) -> Cause:
    """Return the cause of an alert of a consent that another screen has changed."""

    def begin(real: Real, visit: str) -> End:
        real.record(visit, "consent", value)

        def end() -> None:
            real.record(visit, "consent", "agreed")

        return end

    return begin


def slow_capture(real: Real, visit: str) -> End:
    real.hold = "stored"
    executor = ThreadPoolExecutor(1)
    made = executor.submit(real.request, "POST", "/api/captures", eye="OD")
    until(lambda: any(data.get("stage") == "keep" for _, data in real.rig.published_events()[-3:]), 30)
    real.clock.advance(30.0)
    real.publish_alerts()

    def end() -> None:
        real.hold = None
        made.result(30)
        executor.shutdown()
        real.publish_alerts()

    return end


CAUSES: dict[str, Cause] = {
    "camera.missing": fault("camera.missing"),
    "camera.stalled": fault("camera.stalled"),
    "light.fault": fault("light.fault"),
    "light.day": dose(0.0),
    "light.limit": dose(22.5 * 3600),
    "heat.warm": temperature(52.0),
    "heat.hot": temperature(61.0),
    "batt.low": charge(0.12),
    "batt.empty": charge(0.03),
    "store.low": free_space(5 * 4 * 10_000_000),
    "store.full": free_space(0),
    "clock.unset": reading(
        lambda real: clock_folder(real).mkdir(parents=True), lambda real: clock_folder(real).rmdir()
    ),
    "clock.wrong": date(-2500),
    "link.other": other_screen,
    "consent.missing": consent(None),
    "consent.declined": consent("declined"),
    "make.slow": slow_capture,
}


def cut_power(instruments: Instruments, before: Real, **target: str) -> Real:
    """Cut the power of an instrument during a capture; return the instrument that starts with its data."""
    eye = "OS" if target.get("slot", "R")[0] == "L" else "OD"
    before.hold = "expose"
    with ThreadPoolExecutor(1) as executor:
        made = executor.submit(before.request, "POST", "/api/captures", eye=eye, **target)
        until(lambda: any(data.get("stage") == "expose" for _, data in before.rig.published_events()[-3:]), 30)
        folder = instruments.new_folder()
        copy_store(before.rig.store.folder, folder)
        before.hold = None
        made.result(30)
    before.close()
    return instruments.build(folder=folder)


def interrupted(instruments: Instruments) -> Real:
    """Return an instrument whose power went off during the picture of the left nerve of its only visit."""
    before = instruments.build()
    visit = before.begin_visit(consent="agreed", sex="woman", age=54)["id"]
    return cut_power(instruments, before, visit=visit, slot="L-nerve")


class StandingAlerts:
    """Instruments that have an alert of `CODES` from their start, shared by the tests of a process."""

    CODES = ("cal.missing", "cal.mismatch", "cal.old", "power.lost", "send.stuck", "send.waiting")

    def __init__(self, instruments: Instruments, undo: ExitStack) -> None:
        self._instruments, self._undo = instruments, undo
        self._made: dict[str, Real] = {}

    def instrument(self, code: str) -> Real:
        """Return the instrument with this alert."""
        name = code.split(".")[0] if code.startswith("send.") else code
        if name not in self._made:
            self._made[name] = self._build(name)
        return self._made[name]

    def _build(self, name: str) -> Real:
        if name == "send":
            return self._undo.enter_context(queued(self._instruments)).real
        build = {
            "cal.missing": lambda: self._instruments.build(Uncalibrated),
            "cal.mismatch": lambda: self._instruments.build(Uncalibrated, is_mismatched=True),
            "cal.old": lambda: self._instruments.build(weeks_old=30.0),
            "power.lost": lambda: interrupted(self._instruments),
        }
        real = build[name]()
        self._undo.callback(real.close)
        return real

    def open(self, page: Page, code: str) -> None:
        """Open the aiming screen of the instrument with this alert, and wait for the alert."""
        real = self.instrument(code)
        visits = real.visits() or [real.begin_visit(consent="agreed", sex="woman", age=54)]
        visit = next((candidate["id"] for candidate in visits if not candidate["finished_at"]), None)
        visit = visit or real.begin_visit(consent="agreed", sex="woman", age=54)["id"]
        page.goto(f"{real.url}/#/visit/{visit}/aim/R-centre")
        expect(page.locator(f"[data-code='{code}']")).to_have_count(1)


@contextmanager
def alert(real: Real, page: Page, code: str) -> Iterator[None]:
    """Cause an alert on a page that aims, and end it after the context."""
    end = CAUSES[code](real, visit_of(page))
    shown = page.locator(f"[data-code='{code}']")
    expect(shown).to_have_count(1)
    yield
    end()
    if code.startswith("consent."):
        page.reload()
    expect(shown).to_have_count(0)
    page.wait_for_selector("eye-live[data-frame]")
