"""Calibration run over HTTP in virtual time: complete, with injected faults, stopped, rolled back; trial lenses."""

import asyncio
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
from device.config.head_file import CalibrationTable, InstrumentSpec, load_head
from device.errors import CalibrationStale, CameraMissing
from device.head import Bench, open_bench, open_head
from device.light_safety.dose_ledger import MemoryLedger
from device.sim.simulated_calibration import simulated_calibration
from services.http.app import create_app
from services.http.authentication import Authenticator
from services.instrument.events import EventBus
from services.instrument.exam import ExamService
from services.instrument.head_arbiter import AppContext, HeadArbiter, archive_path, with_calibration
from services.instrument.watchdog import Watchdog
from services.records.capture import BUDGET_S
from services.records.capture_store import CaptureStore
from services.records.capture_target import TEST_PICTURE
from tests.journey.conftest import SMALL_HEAD, until
from tests.simulated import world
from tests.unit.test_trial_lenses import WHO

FLAWS = "\n[sim.sensor]\nprnu = 0.01\ndsnu_e = 2.0\nhot_pixels = 0.0003\n"
TINY = (
    SMALL_HEAD.replace("rows = 270", "rows = 136")
    .replace("cols = 480", "cols = 240")
    .replace("20.16", "40.32")
    .replace("haemorrhages = 3", 'kind = "point"')  # saves the simulation of vessels
)
CHIPS = '\n[bus]\nbackend = "sim"\nthermometer = 0x48\nmemory = 0x50\n'
ALONE = (lambda: BUDGET_S, lambda _: TEST_PICTURE)  # no other time budget, no visits
STANDS = ("cap", "screen", "point")


@dataclass
class Station:
    """Instrument for calibration, HTTP client with cookies, and the opened benches."""

    owner: HeadArbiter
    app: FastAPI
    clock: VirtualClock
    benches: list[Bench]
    died: Event = field(default_factory=Event)
    cookies: httpx.Cookies = field(default_factory=httpx.Cookies)

    def ask(self, method: str, path: str, body: Any = None) -> httpx.Response:
        async def send() -> httpx.Response:
            transport = httpx.ASGITransport(app=self.app)
            async with httpx.AsyncClient(
                transport=transport,
                base_url="http://diffuscope.local",
                cookies=self.cookies,
                headers={"X-Controller": "test"},
            ) as client:
                answer = await client.request(method, path, json=body, timeout=30)
                self.cookies = client.cookies
                return answer

        return asyncio.run(send())

    def post(self, path: str, body: Any = None) -> dict[str, Any]:
        answer = self.ask("POST", path, {} if body is None else body)
        assert answer.status_code == 200, answer.text
        content: dict[str, Any] = answer.json()
        return content

    def refused(self, path: str, body: Any = None) -> tuple[int, str]:
        answer = self.ask("POST", path, {} if body is None else body)
        assert set(answer.json()) == {"code", "message", "remedy"}, answer.text
        return answer.status_code, answer.json()["code"]

    def state(self) -> dict[str, Any]:
        state: dict[str, Any] = self.ask("GET", "/api/calibration").json()
        return state

    def start(self) -> None:
        until(lambda: self.state()["state"] in ("idle", "begin"))
        self.post("/api/calibration", {"by": "Ada"})

    def await_request(self) -> str:
        """Wait until the run requests a stand or ends; return the stand or the state."""
        states: list[dict[str, Any]] = []

        def settled() -> bool:
            states.append(self.state())
            return states[-1]["state"] not in ("measuring", "begin")

        until(settled)
        return str(states[-1]["stand"] if states[-1]["state"] == "asking" else states[-1]["state"])

    def ready(self, stand: str, **more: str) -> None:
        self.post("/api/calibration/ready", {"stand": stand} | more)

    def calibrate(self) -> str:
        self.start()
        for stand in STANDS:
            assert self.await_request() == stand
            self.ready(stand)
        assert self.await_request() not in STANDS, self.state()["error"]
        made: str = self.state()["made"]["id"]
        return made


MakeStation = Callable[..., Station]


@pytest.fixture
def make_station(tmp_path: Path, plans: Path) -> Iterator[MakeStation]:
    with ExitStack() as undo:

        def made(toml: str = TINY + FLAWS, archive: bool = False, stale: Callable[[], bool] = lambda: False) -> Station:
            (tmp_path / "head.toml").write_text(toml)
            spec: InstrumentSpec = load_head(tmp_path / "head.toml")
            if archive:
                spec = spec.model_copy(update={"calibration": CalibrationTable(archive=tmp_path / "archive")})
            clock, died = VirtualClock(), Event()
            ledger = MemoryLedger(clock)
            store = undo.enter_context(CaptureStore(tmp_path / "store", reserve_bytes=0))
            root = archive_path(spec, tmp_path)
            context = AppContext(spec, Archive(root), store, EventBus(), clock, Watchdog(None), died.set)
            benches: list[Bench] = []

            def exam() -> ExamService:
                if stale():
                    raise CalibrationStale("the point has moved by 3 pixels")
                head = open_head(with_calibration(spec, root), clock, ledger)
                return ExamService(head, store, context.event_bus, clock, plans, died.set, Watchdog(None), *ALONE)

            def bench() -> Bench:
                benches.append(opened := open_bench(spec, clock))
                assert opened.world is not None
                opened.world.frames = 1000 * len(benches)  # each bench has another noise realisation
                return opened

            owner = HeadArbiter(context, exam, bench)
            undo.callback(owner.close)
            app = create_app(owner, Authenticator(tmp_path / "access", clock, has_demo=True)).http
            return Station(owner, app, clock, benches, died)

        yield made


@pytest.fixture
def station(make_station: MakeStation) -> Station:
    return make_station()


def test_a_complete_calibration_with_a_fault_at_every_step(station: Station) -> None:
    faults = {"cap": "lamp on", "screen": "finger", "point": "moving"}
    numbers = {"cap": "the lamp was on in frame", "screen": "differs by", "point": "has moved by 1.0 pixels"}
    station.start()
    for k, stand in enumerate(STANDS):
        assert station.await_request() == stand
        assert station.refused("/api/calibration/ready", {"stand": "eye"})[0] == 409  # another stand is requested
        station.ready(stand, mishap=faults[stand])
        assert station.await_request() == stand  # the same step is requested again
        state = station.state()
        assert state["error"]["code"] == "calibration.refused"
        assert numbers[stand] in state["error"]["message"]
        assert [step["state"] for step in state["steps"]] == ["done"] * k + ["now"] + ["todo"] * (2 - k)
        assert state["in_force"] is None
        station.ready(stand)
    assert station.await_request() in ("idle", "starting")
    state, camera = station.state(), station.owner.context.spec.camera
    made = state["made"]
    assert state["in_force"]["id"] == made["id"]
    assert (made["made_by"], made["serial"], made["simulated"]) == ("Ada", "simulated", True)
    assert made["numbers"]["gain_e_per_dn"] == pytest.approx(camera.gain_e_per_dn, rel=0.01)
    assert made["numbers"]["black_dn"] == pytest.approx(camera.black_dn, abs=0.2)
    assert made["numbers"]["read_noise_e"] == pytest.approx(camera.read_noise_e, rel=0.05)
    picture = station.ask("POST", "/api/captures", {"eye": "OD"}).json()
    assert picture["calibration_id"] == made["id"]


def test_captures_are_refused_during_a_calibration(station: Station) -> None:
    station.start()
    assert station.await_request() == "cap"
    assert station.refused("/api/captures", {"eye": "OD"}) == (409, "busy")
    assert "calibrating" in station.ask("GET", "/api/status").json()["problem"]["message"]
    assert station.ask("GET", "/api/health").json()["ok"] is False
    assert station.ask("GET", "/api/preview?after=0").status_code == 204
    assert station.refused("/api/calibration", {"by": "Bob"}) == (409, "busy")
    station.post("/api/calibration/cancel")
    until(lambda: station.ask("GET", "/api/health").json()["ok"])
    assert station.ask("POST", "/api/captures", {"eye": "OD"}).status_code == 201


def test_what_the_sensor_sees_is_shown_with_its_levels(station: Station) -> None:
    def seen(after: int = 0) -> httpx.Response:
        answer = station.ask("GET", f"/api/calibration/preview?after={after}")
        assert answer.status_code == 200
        return answer

    assert station.ask("GET", "/api/calibration/preview").status_code == 204
    station.start()
    levels = {}
    for stand in STANDS:
        assert station.await_request() == stand
        first = seen()
        answer = seen(int(first.headers["x-frame"]))
        with Image.open(BytesIO(answer.content)) as picture:
            assert picture.format == "JPEG"
            assert picture.size == (240, 136)
        levels[stand] = float(answer.headers["x-brightest"]), float(answer.headers["x-mean"])
        assert int(answer.headers["x-age-ms"]) >= 0
        if stand != "point":
            station.ready(stand)
    assert levels["cap"][0] < 80
    assert levels["screen"][1] > 1000
    assert levels["point"][0] > 5 * levels["point"][1]  # a bright pattern on a black background


def test_a_stopped_calibration_changes_nothing_and_its_steps_are_resumed(station: Station) -> None:
    old = station.calibrate()
    for done, stand in enumerate(STANDS):
        station.start()
        assert station.await_request() == (stand if done < 1 else STANDS[done - 1])
        if done:
            station.ready(STANDS[done - 1])
            assert station.await_request() == stand
        assert all(step["found"] for step in station.state()["steps"][:done])
        station.post("/api/calibration/cancel")
        state = station.state()
        assert state["in_force"]["id"] == old
        assert state["unfinished"] == list(STANDS[:done])
    station.start()
    assert station.await_request() == "point"
    station.ready("point")
    assert station.await_request() not in STANDS
    assert station.state()["in_force"]["id"] != old


def test_rollback_to_an_earlier_calibration_and_from_a_damaged_one(make_station: MakeStation, tmp_path: Path) -> None:
    station = make_station(TINY + FLAWS + CHIPS, archive=True)
    first, second = station.calibrate(), station.calibrate()
    assert first != second
    assert [calibration["id"] for calibration in station.state()["kept"]] == [second, first]
    until(lambda: station.state()["state"] == "idle")
    assert station.post("/api/calibration/use", {"id": first})["in_force"]["id"] == first
    memory = station.benches[-1].chips.memory
    assert memory is not None
    identity = memory.read()
    assert identity is not None
    assert identity.calibration_id == first  # the memory of the head names it
    assert station.ask("POST", "/api/captures", {"eye": "OS"}).json()["calibration_id"] == first
    assert station.refused("/api/calibration/use", {"id": "0" * 16}) == (423, "calibration.missing")
    assert station.refused("/api/calibration/use", {"id": "../store"}) == (422, "input")
    station.owner.close()

    (tmp_path / "archive" / first / "psf0.npy").write_bytes(b"not what was kept")
    reopened = make_station(archive=True)
    assert reopened.refused("/api/captures", {"eye": "OD"}) == (423, "calibration.damaged")
    state = reopened.state()
    assert state["needed"]["code"] == "calibration.damaged"
    assert {calibration["id"]: calibration["damaged"] is None for calibration in state["kept"]} == {
        first: False,
        second: True,
    }
    assert reopened.refused("/api/calibration/use", {"id": first}) == (423, "calibration.damaged")
    state = reopened.post("/api/calibration/use", {"id": second})
    assert state["needed"] is None
    assert state["in_force"]["id"] == second


def test_without_a_calibration_the_page_is_served_and_a_session_waits(make_station: MakeStation) -> None:
    station = make_station(archive=True)
    assert station.ask("GET", "/").status_code == 200
    assert station.ask("GET", "/technician").status_code == 200
    assert station.ask("GET", "/api/status").json()["problem"]["code"] == "calibration.missing"
    assert station.refused("/api/captures", {"eye": "OD"}) == (423, "calibration.missing")
    state = station.state()
    assert state["state"] == "begin"
    assert state["needed"]["code"] == "calibration.missing"
    assert state["needed"]["remedy"]
    station.start()
    assert station.await_request() == "cap"
    station.post("/api/calibration/cancel")
    assert station.state()["state"] == "begin"
    id = station.calibrate()
    assert station.state()["needed"] is None
    assert station.ask("POST", "/api/captures", {"eye": "OD"}).json()["calibration_id"] == id


def test_a_stale_calibration_is_refused_until_a_new_one_is_measured(make_station: MakeStation) -> None:
    old = [True]
    station = make_station(stale=lambda: old[0])
    assert station.refused("/api/captures", {"eye": "OD"}) == (423, "calibration.stale")
    assert station.state()["needed"]["message"] == "the point has moved by 3 pixels"
    old[0] = False
    station.calibrate()
    assert station.ask("POST", "/api/captures", {"eye": "OD"}).status_code == 201


def test_a_missing_camera_is_reported_and_recovers(station: Station) -> None:
    station.start()
    assert station.await_request() == "cap"
    world = station.benches[-1].world
    assert world is not None
    world.faults.add("camera.missing")
    station.ready("cap")
    until(lambda: (station.state()["error"] or {}).get("code") == "camera.missing")
    world.faults.clear()
    assert station.await_request() == "cap"
    station.ready("cap")
    assert station.await_request() == "screen"
    assert station.state()["error"] is None


def test_a_full_disk_is_reported_and_the_step_is_requested_again(station: Station, tmp_path: Path) -> None:
    station.start()
    assert station.await_request() == "cap"
    archive = station.owner.context.archive.root
    archive.parent.mkdir(parents=True, exist_ok=True)
    archive.write_text("a file where the folder should be")
    station.ready("cap")
    assert station.await_request() == "cap"
    assert station.state()["error"]["code"] == "store.full"
    archive.unlink()
    station.ready("cap")
    assert station.await_request() == "screen"


BAD = [
    {},
    {"by": ""},
    {"by": "   "},
    {"by": "a\nb"},
    {"by": "x" * 61},
    {"by": "Ada", "source_deg": -1},
    {"by": "Ada", "source_deg": 6},
    {"by": "Ada", "lamp": 1},
    {"by": "Ada", "serial": " "},
]


@pytest.mark.parametrize("body", BAD)
def test_an_invalid_start_is_422_and_the_exam_keeps_the_head(lasting: Station, body: Any) -> None:
    assert lasting.refused("/api/calibration", body) == (422, "input")
    assert lasting.refused("/api/calibration/ready", {"stand": "cap"}) == (409, "busy")
    assert lasting.owner.owner.session is None


@pytest.fixture(scope="module")
def lasting(plans: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Station]:
    """A station shared by a module; no calibration is started, so the exam keeps the head."""
    folder = tmp_path_factory.mktemp("lasting")
    (folder / "head.toml").write_text(TINY)
    spec, clock = load_head(folder / "head.toml"), VirtualClock()
    with CaptureStore(folder / "store", reserve_bytes=0) as store:
        context = AppContext(spec, Archive(folder / "archive"), store, EventBus(), clock, Watchdog(None), Event().set)
        head = open_head(spec, clock, MemoryLedger(clock))
        exam = ExamService(head, store, context.event_bus, clock, plans, context.on_failure, Watchdog(None), *ALONE)
        owner = HeadArbiter(context, lambda: exam, lambda: open_bench(spec, clock))
        app = create_app(owner, Authenticator(folder / "access", clock, has_demo=True)).http
        yield Station(owner, app, clock, [])
        owner.close()


def test_a_bench_that_cannot_be_opened_returns_the_head_to_the_exam(make_station: MakeStation) -> None:
    station = make_station()

    def broken() -> Bench:
        raise CameraMissing("the simulated camera does not answer")

    until(lambda: station.state()["state"] == "idle")
    owner = HeadArbiter(station.owner.context, lambda: station.owner.exam, broken)
    authenticator = Authenticator(station.owner.context.store.folder / "access", station.clock, has_demo=True)
    other = Station(owner, create_app(owner, authenticator).http, station.clock, [])
    other.post("/api/calibration", {"by": "Ada"})
    until(lambda: other.state()["error"] is not None)
    assert other.state()["error"]["code"] == "camera.missing"
    assert owner.owner.session is None
    assert not station.died.is_set()


# Trial lenses


LENSES = "/api/calibration/trial-lenses"


def await_lens(station: Station, number: int) -> dict[str, Any]:
    """Wait until this lens is asked for; return the description of the run."""
    until(lambda: (station.state()["lenses"] or {"lens": None})["lens"] == number, 60)
    until(lambda: station.state()["lenses"]["state"] == "asking", 60)
    run: dict[str, Any] = station.state()["lenses"]
    return run


def begin_lenses(station: Station, **options: float) -> None:
    until(lambda: station.state()["state"] == "idle")
    station.post(LENSES, options)
    await_lens(station, 0)


@pytest.fixture
def calibrated(make_station: MakeStation, tmp_path: Path) -> Station:
    """A station of a head with a calibration in force, which sees a point: its pixels measure lenses, but not well."""
    (tmp_path / "head.toml").write_text(TINY)
    of = world(load_head(tmp_path / "head.toml"))
    Archive(tmp_path / "archive").add_and_activate(simulated_calibration(of), WHO)
    return make_station(TINY, archive=True)


def test_a_head_outside_its_limits_shows_readings_and_findings_and_keeps_its_calibration(calibrated: Station) -> None:
    before = calibrated.state()["in_force"]["id"]
    begin_lenses(calibrated, vertex_mm=13.0)
    for number in range(6):
        run = await_lens(calibrated, number)
        assert [row["state"] for row in run["rows"]] == ["done"] * number + ["now"] + ["todo"] * (5 - number)
        assert all((row["measured"] is None) == (row["state"] != "done") for row in run["rows"])
        assert calibrated.refused(f"{LENSES}/ready", {"lens": 5 - number}) == (409, "busy")
        calibrated.post(f"{LENSES}/ready", {"lens": number})
    until(lambda: calibrated.state()["state"] == "idle", 60)
    state = calibrated.state()
    run = state["lenses"]
    assert (run["state"], run["vertex_mm"], run["stored_id"]) == ("done", 13.0, None)
    assert run["rows"][1]["nominal"]["m_dpt"] == pytest.approx(-2 / (1 + 0.013 * 2))
    for row in run["rows"]:
        assert row["measured"]["m_dpt"] == pytest.approx(row["nominal"]["m_dpt"], abs=4 * row["sd"]["m_dpt"])
    failing = [finding for finding in run["findings"] if not finding["ok"]]
    assert run["error"]["remedy"] in [finding["remedy"] for finding in failing]
    assert run["error"] == state["error"]
    assert [calibration["id"] for calibration in state["kept"]] == [state["in_force"]["id"]] == [before]
    assert "trial_offset_dpt" not in state["in_force"]["numbers"]
    assert calibrated.ask("POST", "/api/captures", {"eye": "OD"}).json()["calibration_id"] == before


def test_a_cancelled_run_returns_the_head_to_the_exam(calibrated: Station) -> None:
    begin_lenses(calibrated)
    assert calibrated.state()["state"] == "lenses"
    assert calibrated.refused("/api/captures", {"eye": "OD"}) == (409, "busy")
    assert calibrated.refused(LENSES) == (409, "busy")
    assert calibrated.refused("/api/calibration", {"by": "Bob"}) == (409, "busy")
    assert calibrated.refused("/api/calibration/ready", {"stand": "cap"}) == (409, "busy")
    assert calibrated.ask("GET", "/api/calibration/preview").status_code == 204
    calibrated.post("/api/calibration/cancel")
    until(lambda: calibrated.state()["state"] == "idle")
    state = calibrated.state()
    assert (state["lenses"], state["error"]) == (None, None)
    assert calibrated.ask("POST", "/api/captures", {"eye": "OD"}).status_code == 201


def test_without_a_calibration_in_force_no_lens_is_measured(make_station: MakeStation) -> None:
    station = make_station(archive=True)
    assert station.refused(LENSES) == (423, "calibration.missing")
    assert station.state()["state"] == "begin"


@pytest.mark.parametrize("body", [{"vertex_mm": -1}, {"vertex_mm": "far"}, {"eye_dpt": 11}, {"lamp": 1}])
def test_an_invalid_request_for_lenses_is_422_and_the_exam_keeps_the_head(lasting: Station, body: Any) -> None:
    assert lasting.refused(LENSES, body) == (422, "input")
    assert lasting.refused(f"{LENSES}/ready", {"lens": -1}) == (422, "input")
    assert lasting.refused(f"{LENSES}/ready", {"lens": 0}) == (409, "busy")
    until(lambda: lasting.state()["state"] == "idle")
    assert lasting.refused(LENSES) == (423, "calibration.missing"), "what a simulated head computes is in no archive"
    assert lasting.owner.owner.session is None
