"""Every state that the page can tell, and the fault of simulated head, shelf or clock that brings it about.

A scenario makes the fault happen on a `Rig` and answers with what the real server then says of it: `Said`, with the
code, the numbers that the page's words need, and what to do where it is a refusal.
"""

import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

from device.sim.world import World
from device.values import Charge
from tests.journey.asking import (
    MAKE_WEEKS,
    MOST_BYTES,
    Attentive,
    Said,
    Shelf,
    agreed_visit,
    aimed,
    answered,
    live,
    pressed,
    stands,
)
from tests.journey.conftest import Rig, until
from tests.simulated import having

WEEKS = 30  # the calibration's age in the scenario of an old one
VISIT = {"key": "0" * 16}


@contextmanager
def seen(rig: Rig, times: float = 1.0, **keys: Any) -> Iterator[None]:
    """Another eye stands there for as long: `times` as much light, and other keys of [sim]."""
    spec = rig.world.spec
    other = World(having(spec, peak_e=spec.sim.peak_e * times, **keys), rig.clock)  # type: ignore[union-attr]  # a simulated head has [sim]
    for colour in ("green", "red"):
        other.electrons_per_s(colour)
    own = {name: getattr(rig.world, name) for name in ("_rates", "_setups")}
    vars(rig.world).update({name: getattr(other, name) for name in own})
    yield
    vars(rig.world).update(own)


def shot(times: float = 1.0, **keys: Any) -> Callable[[Rig, Shelf], Said]:
    def scenario(rig: Rig, shelf: Shelf) -> Said:
        with seen(rig, times, **keys):
            return pressed(rig)

    return scenario


def fault(name: str, ask: Callable[[Rig], Said]) -> Callable[[Rig, Shelf], Said]:
    def scenario(rig: Rig, shelf: Shelf) -> Said:
        rig.world.faults.add(name)
        return ask(rig)

    return scenario


def no_eye(rig: Rig, shelf: Shelf) -> Said:
    rest(rig)
    rig.clock.sleep(60)
    rig.world.faults.add("eye.closed")
    return pressed(rig)


def blink(rig: Rig, shelf: Shelf) -> Said:
    live(rig, live(rig, 0))
    assert isinstance(rig.bulletin, Attentive)
    rig.bulletin.at_the_press = lambda: rig.world.faults.add("eye.closed")
    return pressed(rig)


def spent(rig: Rig, ago_s: float) -> None:
    """The right eye has had nearly all the light of a day, so long ago; what a press reserves does not fit any more."""
    light = rig.exam.head.light
    left = light.hazard.limits.stop_j_per_cm2 - light.ledger.spent_j_per_cm2("OD")
    light.ledger.reserve(("OD",), 0.999 * left, light.hazard.limits.stop_j_per_cm2)
    rig.clock.sleep(ago_s)


def light_limit(rig: Rig, shelf: Shelf) -> Said:
    spent(rig, 22.5 * 3600)
    said = pressed(rig)
    assert 0 < said.facts["n"] <= 180
    assert pressed(rig, "OS").way == "verdict", "the other eye can go on"
    live(rig, 0, "OS")
    rest(rig)  # while a light shines, what it may cost at most is counted, and afterwards what it did cost
    ledger = rig.exam.head.light.ledger
    before = ledger.spent_j_per_cm2("OD"), ledger.spent_j_per_cm2("OS")
    live(rig, rig.exam._preview.number, "OS")
    rest(rig)
    assert ledger.spent_j_per_cm2("OD") == before[0], "aiming at one eye costs the other nothing"
    assert ledger.spent_j_per_cm2("OS") > before[1]
    rig.clock.sleep(60 * said.facts["n"])
    assert pressed(rig).way == "verdict", "after its rest the eye gets light again"
    return said


def light_day(rig: Rig, shelf: Shelf) -> Said:
    spent(rig, 0.0)
    said = pressed(rig)
    assert pressed(rig, "OS").way == "verdict", "the other eye can go on"
    rig.clock.sleep(25 * 3600)
    return said


def warm(celsius: float, code: str) -> Callable[[Rig, Shelf], Said]:
    def scenario(rig: Rig, shelf: Shelf) -> Said:
        rig.world.celsius = celsius
        said = stands(rig, code)
        if code == "heat.hot":
            assert said.facts == {"wait_s": 300}
            rig.clock.sleep(48)
            standing = rig.request("GET", "/api/status").json()["standing"]
            assert {"code": code, "wait_s": 252} in standing
            refused = pressed(rig)
            assert (refused.way, refused.code) == ("423", "head.hot")
            return replace(said, remedy=refused.remedy)
        assert pressed(rig).way == "verdict"
        return said

    return scenario


def charged(fraction: float, code: str) -> Callable[[Rig, Shelf], Said]:
    def scenario(rig: Rig, shelf: Shelf) -> Said:
        rig.world.charge = Charge(fraction, 3.5)
        said = stands(rig, code)
        if code == "batt.empty":
            refused = pressed(rig)
            assert (refused.way, refused.code) == ("423", "power.low")
            return replace(said, remedy=refused.remedy)
        assert pressed(rig).way == "verdict"
        return said

    return scenario


def full(rig: Rig, shelf: Shelf) -> Said:
    kept = rig.request("GET", "/api/captures").json()
    shelf.free_bytes = 0
    said = stands(rig, "store.full")
    refused = pressed(rig)
    assert (refused.way, refused.code) == ("507", "store.full")
    assert rig.request("GET", "/api/captures").json() == kept, "nothing that was kept is lost"
    shelf.free_bytes = MOST_BYTES
    rig.app.state.notices.look()
    assert rig.told()[-1] == ("notice", {"code": "store.full", "over": True})
    assert pressed(rig).way == "verdict", "space is back: it goes on"
    return replace(said, remedy=refused.remedy)


def low(rig: Rig, shelf: Shelf) -> Said:
    shelf.free_bytes = (
        5 * 4 * 10_000_000
        if not rig.store.captures(1)
        else 40
        * sum(path.stat().st_size for path in (rig.store.folder / "captures" / rig.store.captures(1)[0].id).iterdir())
    )
    return stands(rig, "store.low")


def slow(rig: Rig, shelf: Shelf) -> Said:
    """The disk takes its time: the picture is in the making for ten seconds, and the page hears of it meanwhile."""
    heard: list[Said] = []

    def dawdle() -> None:
        if rig.exam.state != "aim" and not heard:
            shelf.asked = lambda: None
            rig.clock.sleep(10)
            heard.append(stands(rig, "make.slow"))

    shelf.asked = dawdle
    assert pressed(rig).way == "verdict"
    return heard[0]


def unmade(rig: Rig, shelf: Shelf) -> Said:
    rig.world.faults.add("camera.mode")
    said = pressed(rig)
    assert said.facts["method"] == "none"
    return said


def poor(rig: Rig, shelf: Shelf) -> Said:
    visit = agreed_visit(rig, "b" * 16)["id"]
    with seen(rig, 0.003):
        told = [pressed(rig, visit=visit, slot="R-centre").code for _ in range(3)]
    assert told[:2] == ["shot.dark"] * 2
    return Said("verdict", told[2], {"n": 3})


def other_screen(rig: Rig, shelf: Shelf) -> Said:
    ours, theirs = "1" * 16, "2" * 16
    assert rig.request("POST", "/api/controller", json={"key": theirs}).json()["mine"]
    answer = rig.request("POST", "/api/captures", json={"eye": "OD"}, headers={"X-Controller": ours})
    rig.request("POST", "/api/controller", json={"key": theirs, "release": True})
    rig.clock.sleep(3)
    assert rig.request("POST", "/api/controller", json={"key": ours}).json()["mine"], "a closed page lets go"
    return Said(str(answer.status_code), answer.json()["code"], {}, answer.json()["remedy"])


def without_consent(value: str | None) -> Callable[[Rig, Shelf], Said]:
    """A consent is withdrawn after the first picture of a visit: the next press gets no light."""

    def scenario(rig: Rig, shelf: Shelf) -> Said:
        visit = agreed_visit(rig)["id"]
        assert pressed(rig, visit=visit, slot="R-centre").way == "verdict"
        answered(rig, visit, "consent", value)
        frames = rig.world.frames
        said = pressed(rig, visit=visit, slot="R-nerve")
        assert (said.way, rig.world.frames) == ("409", frames)
        return said

    return scenario


def locked(rig: Rig, shelf: Shelf) -> Said:
    rig.door.set_pin("2468", None)
    answer = rig.request("GET", "/api/calibration")
    return Said(str(answer.status_code), answer.json()["code"], {}, answer.json()["remedy"])


def wrong_date(rig: Rig, shelf: Shelf) -> Said:
    rig.clock.start -= timedelta(days=365 * 6)
    return stands(rig, "clock.wrong")


def other_eye(rig: Rig, shelf: Shelf) -> Said:
    rig.world.faults.add("eye.other")
    visit = agreed_visit(rig)["id"]
    assert pressed(rig, visit=visit, slot="R-centre").code == "good"
    return stands(rig, "eye.side")


def old(rig: Rig, shelf: Shelf) -> Said:
    rig.clock.sleep((WEEKS - MAKE_WEEKS) * 7 * 86400.0)
    said = stands(rig, "cal.old")
    assert said.facts["n"] >= WEEKS
    assert pressed(rig).way == "verdict"
    return said


def cut_off(rig: Rig, again: Callable[[], Rig], folder: Path) -> Said:
    """The power goes while the second picture of a visit is in the making: the shelf as it is then is opened anew."""
    visit = agreed_visit(rig, "c" * 16)["id"]
    assert pressed(rig, visit=visit, slot="R-centre").way == "verdict"
    rig.hang()
    errand = {"eye": "OS", "visit": visit, "slot": "L-nerve"}
    answer = rig.exam.press("OS", None, people(rig).errand("OS", None, visit, "L-nerve"))
    rig.wait_for_hanging()
    shutil.copytree(rig.store.folder, folder / "shelf")
    rig.clock.gate.set()
    answer.result(30)
    started = again()
    lost = started.request("GET", "/api/status").json()["swept"]
    assert len(lost) == 1
    assert errand.items() <= lost[0].items()
    assert pressed(started, "OS", visit=visit, slot="L-nerve").way == "verdict"
    assert started.request("GET", "/api/status").json()["swept"] == [], "it was taken again"
    return Said("status", "power.lost", {"eye": lost[0]["eye"], "slot": lost[0]["slot"]})


def unsent(rig: Rig, shelf: Shelf, answers: dict[str, int]) -> dict[str, Any]:
    """One more visit is finished, and the receiver says no: what the Send screen lists of it."""
    number = rig.app.state.notices.sender.outbox.trouble().waiting + len(shelf.receiver.kept)
    key = f"{number + 256:016x}"
    visit = agreed_visit(rig, key)["id"]
    assert pressed(rig, visit=visit, slot="R-centre").way == "verdict"
    rig.request("POST", f"/api/visits/{visit}/finish", json={"key": key[::-1]})
    shelf.receiver.answers = answers
    sent(rig)
    listed = rig.request("GET", "/api/outbox").json()
    assert (listed["configured"], listed["waiting"]) == (True, len(listed["visits"]))
    assert rig.request("GET", "/api/status").json()["sending"]["waiting"] == listed["waiting"]
    one: dict[str, Any] = next(one for one in listed["visits"] if one["visit"] == visit)
    assert one["size_bytes"] > 1000
    return one


def sent(rig: Rig) -> None:
    """As its thread does it, once nobody aims."""
    rest(rig)
    rig.clock.sleep(6)
    until(lambda: rig.owner.is_idle, 120)
    while rig.app.state.notices.sender.step():
        pass


def is_over(rig: Rig, code: str) -> None:
    """It stands no longer, and that was the last news of it."""
    rig.app.state.notices.look()
    assert code not in {one["code"] for one in rig.request("GET", "/api/status").json()["standing"]}
    assert [data for _, data in rig.told() if data.get("code") == code][-1] == {"code": code, "over": True}


def waits_for_the_link(rig: Rig, shelf: Shelf) -> Said:
    one = unsent(rig, shelf, {"HEAD": 503})
    assert (one["tries"], one["stuck"], one["error"]["code"]) == (1, False, "send.link")
    assert "503" in one["error"]["message"]
    said = stands(rig, "send.waiting")
    assert pressed(rig).way == "verdict", "nobody who is examined waits for the link"
    shelf.receiver.answers = {}
    rig.clock.sleep(60)
    sent(rig)
    is_over(rig, "send.waiting")
    return said


def is_stuck(rig: Rig, shelf: Shelf) -> Said:
    before = len(shelf.receiver.kept)
    one = unsent(rig, shelf, {"PUT": 403})
    assert (one["stuck"], one["error"]["code"]) == (True, "send.key")
    assert len(one["error"]["remedy"]) > 20
    said = stands(rig, "send.stuck")
    assert pressed(rig).way == "verdict"
    shelf.receiver.answers = {}
    assert rig.request("POST", "/api/outbox/try", json={"key": "f" * 16}).json()["next_try_s"] == 0
    sent(rig)
    is_over(rig, "send.stuck")
    assert len(shelf.receiver.kept) == before + 1
    return said


def people(rig: Rig) -> Any:
    return rig.app.state.notices._people


EYE = {"eye": {}}
SCENARIOS: dict[str, Callable[[Rig, Shelf], Said]] = {
    "camera.missing": fault("camera.missing", pressed),
    "camera.stalled": fault("camera.stalled", aimed),
    "light.fault": fault("light.fault", pressed),
    "light.limit": light_limit,
    "light.day": light_day,
    "cal.old": old,
    "shot.saturated": shot(6.0),
    "shot.dark": shot(0.003),
    "shot.pupil": shot(eye={"pupil_um": 1500.0}),
    "shot.moved": shot(eye={"drift_deg_per_s": 20.0}),
    "shot.blink": blink,
    "shot.noeye": no_eye,
    "shot.edge": shot(eye={"pupil_um": 4000.0, "decentred_um": 2500.0}),
    "shot.halo": shot(light={"polariser_leak": 0.1, "ring_um": 3500.0}),
    "shot.poor": poor,
    "make.slow": slow,
    "make.failed": unmade,
    "store.low": low,
    "store.full": full,
    "batt.low": charged(0.12, "batt.low"),
    "batt.empty": charged(0.03, "batt.empty"),
    "heat.warm": warm(52.0, "heat.warm"),
    "heat.hot": warm(61.0, "heat.hot"),
    "link.other": other_screen,
    "lock.idle": locked,
    "consent.missing": without_consent(None),
    "consent.declined": without_consent("declined"),
    "send.waiting": waits_for_the_link,
    "send.stuck": is_stuck,
    "clock.wrong": wrong_date,
    "eye.side": other_eye,
}
# These need an instrument of their own: see test_fault_states.py.
APART = frozenset({"cal.missing", "cal.mismatch", "power.lost"})
# The page alone knows that nothing arrives: the tests that cut or slow a real browser's link.
OF_THE_PAGE = {
    "link.lost": ("test_page.py", "test_a_frozen_server_is_told_within_five_seconds_and_forgotten_within_three"),
    "link.slow": ("test_page_states.py", "test_an_old_live_picture_says_its_age"),
    "light.cut": ("test_sides.py", "test_a_light_that_went_out_too_early_leaves_one_on_that_tile"),
    "shot.lost": ("test_sides.py", "test_a_good_picture_that_is_lost_after_next_is_told_until_it_is_taken"),
    "shot.crossed": ("test_sides.py", "test_a_tile_can_be_crossed_while_aiming_and_uncrossed"),
}


def page_code(web: Path, code: str) -> str:
    """The page's own name of what the server calls `code` (web/states.js)."""
    table = (web / "states.js").read_text().split("const SAME = {")[1].split("};")[0]
    same = dict(re.findall(r'"([\w.]+)": "([\w.]+)"', table))
    return same.get(code, code)


def rest(rig: Rig) -> None:
    """Nobody aims any more: time may jump, and no lamp shines meanwhile. Until then a busy computer makes pictures."""
    wanted_until_s = rig.exam._wanted_until_s
    until(lambda: rig.clock.now_s() >= wanted_until_s and rig.world.glow is None and rig.exam.state == "aim", 120)


def mended(rig: Rig) -> None:
    """All is well again, whatever a scenario broke."""
    world = rig.world
    world.faults.clear()
    world.celsius, world.charge = 25.0, Charge(0.775, 3.88)
    rest(rig)
    until(lambda: not rig.exam.fitness.due, 120)
    for heap in (rig.exam.fitness._sights, rig.exam.fitness._spheres_dpt):
        heap.clear()  # what was broken here says nothing about the next scenario
    for one in rig.request("GET", "/api/status").json()["standing"]:
        if one["code"] == "eye.side":  # or the next scenario is asked it
            rig.request("POST", f"/api/captures/{one['id']}/eye", json={"key": secrets.token_hex(8), "eye": "OD"})
