"""The calibration wizard over HTTP, on a simulated head in virtual time: whole, with mishaps, stopped, gone back."""

import asyncio
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from threading import Event
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from PIL import Image

from device.calibration.archive import Archive
from device.clock import VirtualClock
from device.errors import CalibrationStale, CameraMissing
from device.head import Bench, open_bench, open_head
from device.ledger import MemoryLedger
from device.spec import CalibrationTable, InstrumentSpec, load_head
from services.instrument.api import create_app
from services.instrument.bulletin import Bulletin
from services.instrument.exam import Exam
from services.instrument.owner import House, Owner, archive_of, calibrated
from services.instrument.technician import IDLE_S, Door
from services.instrument.watchdog import Watchdog
from services.records.store import Store
from tests.journey.conftest import SMALL_HEAD

FLAWS = "\n[sim.sensor]\nprnu = 0.01\ndsnu_e = 2.0\nhot_pixels = 0.0003\n"
TINY = (
    SMALL_HEAD.replace("rows = 270", "rows = 136").replace("cols = 480", "cols = 240").replace("20.16", "40.32")
    .replace("haemorrhages = 3", 'kind = "point"')  # no vessels need to grow
)  # fmt: skip
CHIPS = '\n[bus]\nbackend = "sim"\nthermometer = 0x48\nmemory = 0x50\n'
STANDS = ("cap", "screen", "point")


def until(holds: Callable[[], bool], patience_s: float = 30.0) -> None:
    """Wait for the thread that owns the head; each look is a request."""
    end = time.monotonic() + patience_s
    while not holds():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.05)


@dataclass
class Shop:
    """An instrument that can be calibrated, a client with a cookie jar, and the benches that were opened."""

    owner: Owner
    app: FastAPI
    clock: VirtualClock
    benches: list[Bench]
    died: Event = field(default_factory=Event)
    cookies: httpx.Cookies = field(default_factory=httpx.Cookies)

    def ask(self, method: str, path: str, body: Any = None) -> httpx.Response:
        async def told() -> httpx.Response:
            transport = httpx.ASGITransport(app=self.app)
            async with httpx.AsyncClient(
                transport=transport,
                base_url="http://eye.local",
                cookies=self.cookies,
                headers={"X-Controller": "test"},
            ) as client:
                answer = await client.request(method, path, json=body, timeout=30)
                self.cookies = client.cookies
                return answer

        return asyncio.run(told())

    def post(self, path: str, body: Any = None) -> dict[str, Any]:
        answer = self.ask("POST", path, {} if body is None else body)
        assert answer.status_code == 200, answer.text
        said: dict[str, Any] = answer.json()
        return said

    def refused(self, path: str, body: Any = None) -> tuple[int, str]:
        answer = self.ask("POST", path, {} if body is None else body)
        assert set(answer.json()) == {"code", "message", "remedy"}, answer.text
        return answer.status_code, answer.json()["code"]

    def state(self) -> dict[str, Any]:
        said: dict[str, Any] = self.ask("GET", "/api/calibration").json()
        return said

    def come_in(self) -> None:
        self.post("/api/technician/pin", {"pin": "1234"})

    def start(self) -> None:
        until(lambda: self.state()["state"] in ("idle", "begin"))
        self.post("/api/calibration", {"by": "Ada"})

    def asked(self) -> str:
        """Wait until something is asked for, or the wizard has ended; what."""
        said: list[dict[str, Any]] = []

        def settled() -> bool:
            said.append(self.state())
            return said[-1]["state"] not in ("measuring", "begin")

        until(settled)
        return str(said[-1]["stand"] if said[-1]["state"] == "asking" else said[-1]["state"])

    def ready(self, stand: str, **more: str) -> None:
        self.post("/api/calibration/ready", {"stand": stand} | more)

    def calibrate(self) -> str:
        self.start()
        for stand in STANDS:
            assert self.asked() == stand
            self.ready(stand)
        assert self.asked() not in STANDS, self.state()["error"]
        made: str = self.state()["made"]["id"]
        return made


MakeShop = Callable[..., Shop]


@pytest.fixture
def make_shop(tmp_path: Path, plans: Path) -> Iterator[MakeShop]:
    with ExitStack() as undo:

        def made(toml: str = TINY + FLAWS, archive: bool = False, stale: Callable[[], bool] = lambda: False) -> Shop:
            (tmp_path / "head.toml").write_text(toml)
            spec: InstrumentSpec = load_head(tmp_path / "head.toml")
            if archive:
                spec = spec.model_copy(update={"calibration": CalibrationTable(archive=tmp_path / "archive")})
            clock, died = VirtualClock(), Event()
            ledger = MemoryLedger(clock)
            store = undo.enter_context(Store(tmp_path / "shelf", reserve_bytes=0))
            root = archive_of(spec, tmp_path)
            house = House(spec, Archive(root), store, Bulletin(), clock, Watchdog(None), died.set)
            benches: list[Bench] = []

            def exam() -> Exam:
                if stale():
                    raise CalibrationStale("the point has moved by 3 pixels")
                head = open_head(calibrated(spec, root), clock, ledger)
                return Exam(head, store, house.bulletin, clock, plans, died.set, Watchdog(None))

            def bench() -> Bench:
                benches.append(opened := open_bench(spec, clock))
                assert opened.world is not None
                opened.world.frames = 1000 * len(benches)  # noise is never the same twice
                return opened

            owner = Owner(house, exam, bench)
            undo.callback(owner.close)
            return Shop(owner, create_app(owner, Door(tmp_path / "technician.json", clock)), clock, benches, died)

        yield made


@pytest.fixture
def shop(make_shop: MakeShop) -> Shop:
    shop = make_shop()
    shop.come_in()
    return shop


BEHIND = [
    ("GET", "/api/calibration"), ("POST", "/api/calibration"), ("POST", "/api/calibration/ready"),
    ("POST", "/api/calibration/cancel"), ("POST", "/api/calibration/use"), ("GET", "/api/calibration/preview"),
    ("POST", "/api/technician/lock"), ("POST", "/api/technician/here"),
]  # fmt: skip


def test_everything_of_the_technician_is_behind_the_pin_and_pictures_are_not(make_shop: MakeShop) -> None:
    shop = make_shop()

    def all_locked() -> None:
        for method, path in BEHIND:
            body = {"by": "Eve", "stand": "cap", "id": "0" * 16} if method == "POST" else None
            answer = shop.ask(method, path, body)
            assert (answer.status_code, answer.json()["code"]) == (401, "technician.locked"), path

    all_locked()
    assert shop.ask("GET", "/api/technician").json()["has_pin"] is False
    shop.come_in()
    assert shop.ask("GET", "/api/technician").json()["open"] is True
    assert shop.state()["kept"] == []
    shop.clock.sleep(IDLE_S)
    all_locked()
    assert shop.refused("/api/technician/unlock", {"pin": "4321"}) == (403, "technician.pin")
    assert shop.refused("/api/technician/unlock", {"pin": "1234"}) == (429, "technician.wait")
    shop.clock.sleep(1)
    shop.post("/api/technician/unlock", {"pin": "1234"})
    shop.post("/api/technician/lock")
    all_locked()
    assert shop.ask("POST", "/api/captures", {"eye": "OD"}).status_code == 201


def test_the_way_in_is_a_cookie_that_scripts_and_other_sites_cannot_use(make_shop: MakeShop) -> None:
    shop = make_shop()
    said = shop.ask("POST", "/api/technician/pin", {"pin": "1234"}).headers["set-cookie"].lower()
    assert "httponly" in said
    assert "samesite=strict" in said
    assert "expires" not in said
    assert "max-age" not in said


def test_a_whole_calibration_with_a_mishap_at_every_step(shop: Shop) -> None:
    mishaps = {"cap": "lamp on", "screen": "finger", "point": "moving"}
    numbers = {"cap": "the lamp was on in frame", "screen": "differs by", "point": "has moved by 1.0 pixels"}
    shop.start()
    for k, stand in enumerate(STANDS):
        assert shop.asked() == stand
        assert shop.refused("/api/calibration/ready", {"stand": "eye"})[0] == 409  # not what is asked for
        shop.ready(stand, mishap=mishaps[stand])
        assert shop.asked() == stand  # the same step again
        said = shop.state()
        assert said["error"]["code"] == "calibration.refused"
        assert numbers[stand] in said["error"]["message"]
        assert [step["state"] for step in said["steps"]] == ["done"] * k + ["now"] + ["todo"] * (2 - k)
        assert said["in_force"] is None
        shop.ready(stand)
    assert shop.asked() in ("idle", "starting")
    said, camera = shop.state(), shop.owner.house.spec.camera
    made = said["made"]
    assert said["in_force"]["id"] == made["id"]
    assert (made["made_by"], made["serial"], made["simulated"]) == ("Ada", "simulated", True)
    assert made["numbers"]["gain_e_per_dn"] == pytest.approx(camera.gain_e_per_dn, rel=0.01)
    assert made["numbers"]["black_dn"] == pytest.approx(camera.black_dn, abs=0.2)
    assert made["numbers"]["read_noise_e"] == pytest.approx(camera.read_noise_e, rel=0.05)
    picture = shop.ask("POST", "/api/captures", {"eye": "OD"}).json()
    assert picture["calibration_id"] == made["id"]


def test_no_picture_is_taken_while_the_technician_has_the_head(shop: Shop) -> None:
    shop.start()
    assert shop.asked() == "cap"
    assert shop.refused("/api/captures", {"eye": "OD"}) == (409, "busy")
    assert "calibrating" in shop.ask("GET", "/api/status").json()["problem"]["message"]
    assert shop.ask("GET", "/api/health").json()["ok"] is False
    assert shop.ask("GET", "/api/preview?after=0").status_code == 204
    assert shop.refused("/api/calibration", {"by": "Bob"}) == (409, "busy")
    shop.post("/api/calibration/cancel")
    until(lambda: shop.ask("GET", "/api/health").json()["ok"])
    assert shop.ask("POST", "/api/captures", {"eye": "OD"}).status_code == 201


def test_what_the_sensor_sees_is_shown_with_its_levels(shop: Shop) -> None:
    def seen(after: int = 0) -> httpx.Response:
        answer = shop.ask("GET", f"/api/calibration/preview?after={after}")
        assert answer.status_code == 200
        return answer

    assert shop.ask("GET", "/api/calibration/preview").status_code == 204
    shop.start()
    levels = {}
    for stand in STANDS:
        assert shop.asked() == stand
        first = seen()
        answer = seen(int(first.headers["x-frame"]))
        with Image.open(BytesIO(answer.content)) as picture:
            assert picture.format == "JPEG"
            assert picture.size == (240, 136)
        levels[stand] = float(answer.headers["x-brightest"]), float(answer.headers["x-mean"])
        assert int(answer.headers["x-age-ms"]) >= 0
        if stand != "point":
            shop.ready(stand)
    assert levels["cap"][0] < 80
    assert levels["screen"][1] > 1000
    assert levels["point"][0] > 5 * levels["point"][1]  # a bright pattern on black


def test_stopped_at_any_step_the_old_stays_and_what_is_measured_is_taken_up(shop: Shop) -> None:
    old = shop.calibrate()
    for done, stand in enumerate(STANDS):
        shop.start()
        assert shop.asked() == (stand if done < 1 else STANDS[done - 1])
        if done:
            shop.ready(STANDS[done - 1])
            assert shop.asked() == stand
        assert all(step["found"] for step in shop.state()["steps"][:done])
        shop.post("/api/calibration/cancel")
        said = shop.state()
        assert said["in_force"]["id"] == old
        assert said["unfinished"] == list(STANDS[:done])
    shop.start()
    assert shop.asked() == "point"
    shop.ready("point")
    assert shop.asked() not in STANDS
    assert shop.state()["in_force"]["id"] != old


def test_back_to_an_earlier_one_and_away_from_a_damaged_one(make_shop: MakeShop, tmp_path: Path) -> None:
    shop = make_shop(TINY + FLAWS + CHIPS, archive=True)
    shop.come_in()
    first, second = shop.calibrate(), shop.calibrate()
    assert first != second
    assert [one["id"] for one in shop.state()["kept"]] == [second, first]
    until(lambda: shop.state()["state"] == "idle")
    assert shop.post("/api/calibration/use", {"id": first})["in_force"]["id"] == first
    memory = shop.benches[-1].chips.memory
    assert memory is not None
    identity = memory.read()
    assert identity is not None
    assert identity.calibration_id == first  # the head itself says so from now on
    assert shop.ask("POST", "/api/captures", {"eye": "OS"}).json()["calibration_id"] == first
    assert shop.refused("/api/calibration/use", {"id": "0" * 16}) == (423, "calibration.missing")
    assert shop.refused("/api/calibration/use", {"id": "../shelf"}) == (422, "input")
    shop.owner.close()

    (tmp_path / "archive" / first / "psf0.npy").write_bytes(b"not what was kept")
    anew = make_shop(archive=True)
    assert anew.refused("/api/captures", {"eye": "OD"}) == (423, "calibration.damaged")
    anew.post("/api/technician/unlock", {"pin": "1234"})
    said = anew.state()
    assert said["needed"]["code"] == "calibration.damaged"
    assert {one["id"]: one["damaged"] is None for one in said["kept"]} == {first: False, second: True}
    assert anew.refused("/api/calibration/use", {"id": first}) == (423, "calibration.damaged")
    said = anew.post("/api/calibration/use", {"id": second})
    assert said["needed"] is None
    assert said["in_force"]["id"] == second


def test_without_a_calibration_the_page_is_served_and_the_wizard_waits(make_shop: MakeShop) -> None:
    shop = make_shop(archive=True)
    assert shop.ask("GET", "/").status_code == 200
    assert shop.ask("GET", "/technician").status_code == 200
    assert shop.ask("GET", "/api/status").json()["problem"]["code"] == "calibration.missing"
    assert shop.refused("/api/captures", {"eye": "OD"}) == (423, "calibration.missing")
    shop.come_in()
    said = shop.state()
    assert said["state"] == "begin"
    assert said["needed"]["code"] == "calibration.missing"
    assert said["needed"]["remedy"]
    shop.start()
    assert shop.asked() == "cap"
    shop.post("/api/calibration/cancel")
    assert shop.state()["state"] == "begin"
    id = shop.calibrate()
    assert shop.state()["needed"] is None
    assert shop.ask("POST", "/api/captures", {"eye": "OD"}).json()["calibration_id"] == id


def test_one_that_no_longer_fits_is_refused_until_a_new_one_is_measured(make_shop: MakeShop) -> None:
    old = [True]
    shop = make_shop(stale=lambda: old[0])
    assert shop.refused("/api/captures", {"eye": "OD"}) == (423, "calibration.stale")
    shop.come_in()
    assert shop.state()["needed"]["message"] == "the point has moved by 3 pixels"
    old[0] = False
    shop.calibrate()
    assert shop.ask("POST", "/api/captures", {"eye": "OD"}).status_code == 201


def test_a_camera_that_stops_is_said_and_comes_back(shop: Shop) -> None:
    shop.start()
    assert shop.asked() == "cap"
    world = shop.benches[-1].world
    assert world is not None
    world.faults.add("camera.missing")
    shop.ready("cap")
    until(lambda: (shop.state()["error"] or {}).get("code") == "camera.missing")
    world.faults.clear()
    assert shop.asked() == "cap"
    shop.ready("cap")
    assert shop.asked() == "screen"
    assert shop.state()["error"] is None


def test_a_full_disk_is_said_and_the_step_is_asked_for_again(shop: Shop, tmp_path: Path) -> None:
    shop.start()
    assert shop.asked() == "cap"
    archive = shop.owner.house.archive.root
    archive.parent.mkdir(parents=True, exist_ok=True)
    archive.write_text("a file where the folder should be")
    shop.ready("cap")
    assert shop.asked() == "cap"
    assert shop.state()["error"]["code"] == "store.full"
    archive.unlink()
    shop.ready("cap")
    assert shop.asked() == "screen"


BAD = [{}, {"by": ""}, {"by": "   "}, {"by": "a\nb"}, {"by": "x" * 61}, {"by": "Ada", "source_deg": -1},
       {"by": "Ada", "source_deg": 6}, {"by": "Ada", "lamp": 1}, {"by": "Ada", "serial": " "}]  # fmt: skip


@pytest.mark.parametrize("body", BAD)
def test_a_start_that_no_button_sends_is_422_and_the_exam_keeps_the_head(lasting: Shop, body: Any) -> None:
    assert lasting.refused("/api/calibration", body) == (422, "input")
    assert lasting.refused("/api/calibration/ready", {"stand": "cap"}) == (409, "busy")
    assert lasting.owner.wizard is None


@pytest.fixture(scope="module")
def lasting(plans: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shop]:
    """One that is never started: the exam keeps the head."""
    folder = tmp_path_factory.mktemp("lasting")
    (folder / "head.toml").write_text(TINY)
    spec, clock = load_head(folder / "head.toml"), VirtualClock()
    with Store(folder / "shelf", reserve_bytes=0) as store:
        house = House(spec, Archive(folder / "archive"), store, Bulletin(), clock, Watchdog(None), Event().set)
        head = open_head(spec, clock, MemoryLedger(clock))
        exam = Exam(head, store, house.bulletin, clock, plans, house.died, Watchdog(None))
        owner = Owner(house, lambda: exam, lambda: open_bench(spec, clock))
        shop = Shop(owner, create_app(owner, Door(folder / "pin.json", clock)), clock, [])
        shop.come_in()
        yield shop
        owner.close()


def test_a_bench_that_cannot_be_opened_gives_the_head_back(make_shop: MakeShop) -> None:
    shop = make_shop()
    shop.come_in()

    def broken() -> Bench:
        raise CameraMissing("the simulated camera does not answer")

    until(lambda: shop.state()["state"] == "idle")
    owner = Owner(shop.owner.house, lambda: shop.owner.exam, broken)
    other = Shop(owner, create_app(owner, Door(shop.owner.house.store.folder / "pin.json", shop.clock)), shop.clock, [])
    other.come_in()
    other.post("/api/calibration", {"by": "Ada"})
    until(lambda: other.state()["error"] is not None)
    assert other.state()["error"]["code"] == "camera.missing"
    assert owner.wizard is None
    assert not shop.died.is_set()
