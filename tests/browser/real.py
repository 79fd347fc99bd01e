"""The real application in this process, on a port: a small simulated head with faults injected while it serves."""

import secrets
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cache, partial
from pathlib import Path
from typing import Any

import httpx
import uvicorn
from starlette.types import ASGIApp, Receive, Scope, Send

from device.calibration.archive import Archive
from device.config.head_file import CalibrationTable, load_head
from device.head import open_bench, open_head, refuse_mismatched_head
from device.light_safety.dose_ledger import MemoryLedger
from device.ports import Chips
from device.sim.chips import SimHeadMemory
from device.sim.world import World
from device.values import Calibration, HeadIdentity
from services.delivery.uploader import HttpsUploader, UploadSettings
from services.delivery.usb_drives import UsbDrives
from services.http.app import create_app
from services.instrument.capture import LiveRequest
from services.instrument.exam import ExamService
from services.instrument.head_arbiter import HeadArbiter
from services.records.capture_store import CaptureStore
from tests.journey.asking import DiskStub, PressHookBus, live_picture, with_all_chips
from tests.journey.conftest import GateClock, Rig, rig_builder, traced_world, until
from tests.simulated import SCENES, coarse, with_keys

BINNING = 8  # of the sensor of the scene, in pixels: 135 x 240 remain; 4 is needed to tell left from right eye
HELD_S = 60.0  # longest hold of a capture
PAGE_PRESS = ("POST", "/api/captures")
# Simulated scenes of poor pictures: factor of the light, and changed keys of [sim].
POOR: dict[str, tuple[float, dict[str, Any]]] = {
    "saturated": (6.0, {}),
    "dark": (0.003, {}),
    "pupil": (1.0, {"eye": {"pupil_um": 1500.0}}),
    "halo": (1.0, {"light": {"polariser_leak": 0.1, "ring_um": 3500.0}}),
    "diffuser": (1.0, {"seed": 2}),  # another one than the calibration has
}


class MovableClock(GateClock):
    """Real time that can be advanced, and a wall clock with an adjustable offset."""

    def __init__(self) -> None:
        super().__init__()
        self.moved, self._ahead_s = timedelta(0), 0.0

    def now_s(self) -> float:
        return time.monotonic() + self._ahead_s

    def wall(self) -> datetime:
        return datetime.now(UTC) + timedelta(seconds=self._ahead_s) + self.moved

    def sleep(self, duration_s: float) -> None:
        if self.world is None or self.world.illumination is not None:
            self.is_sleeping.set()
            assert self.gate.wait(HELD_S)
        time.sleep(max(0.0, duration_s))

    def advance(self, duration_s: float) -> None:
        """Advance monotonic time and date together."""
        self._ahead_s += duration_s


class HoldingBus(PressHookBus):
    """Event bus that holds a capture: `publish` does not return while `hold` is the stage that it has published.

    `look` is the quick look that is published while the next frames are exposed.
    """

    hold: str | None = None

    def publish(self, kind: str, **data: Any) -> None:
        super().publish(kind, **data)
        if kind == "stage":
            is_look = data["stage"] == "expose" and data["url"] is not None
            self.wait_while_held("look" if is_look else str(data["stage"]))

    def wait_while_held(self, stage: str) -> None:
        until(lambda: self.hold != stage, HELD_S)


class Disk(DiskStub):
    """Free space of the disk; the storage of a capture is held at the stage "keep", and fails while `is_failing`."""

    bus: HoldingBus
    is_failing = False

    def __call__(self, folder: Path) -> int:
        if not threading.current_thread().name.startswith("aside"):  # the thread that stores a capture
            return super().__call__(folder)
        self.bus.wait_while_held("stored")
        return 0 if self.is_failing else self.free_bytes


class RecordedRequests:
    """ASGI application that counts the captures which pages requested.

    One from outside the page gets the key of the last page, which holds the control lease.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app, self.presses = app, 0
        self._page_key: list[tuple[bytes, bytes]] = []

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            key = [header for header in scope["headers"] if header[0] == b"x-controller"]
            self._page_key = key or self._page_key
            if (scope["method"], scope["path"]) == PAGE_PRESS:
                self.presses += bool(key)
                scope["headers"] = [*scope["headers"], *([] if key else self._page_key)]
        await self.app(scope, receive, send)


@cache
def small_template(binning: int = BINNING) -> tuple[World, Calibration]:
    """Return the traced world and calibration of the small head, shared by all tests of this process."""
    return traced_world(coarse(load_head(SCENES / "calm.toml"), binning))


@cache
def poor_world(cause: str, binning: int) -> World:
    """Return the world of a scene of POOR with its light traced."""
    times, keys = POOR[cause]
    spec = small_template(binning)[0].spec
    assert spec.sim is not None
    world = World(with_keys(spec, peak_e=spec.sim.peak_e * times, **keys), MovableClock())
    world.present_eye("OS")
    world.present_eye("OD")
    return world


class Real:
    """Running instrument: `rig` holds its parts, `clock` its time, `free_space` its reported storage space.

    `stick` is the folder of a simulated USB drive, mounted between `mount` and `unmount`. `hold` stops captures after
    the stage "expose" (before the light), "quick" (quick look shown) or "stored" (before storage, live pictures go on).
    """

    def __init__(
        self,
        folder: Path,
        plans: Path,
        weeks_old: float = 0.0,
        uploads: dict[str, object] | None = None,
        binning: int = BINNING,
        **options: Any,
    ) -> None:
        self.clock, self.free_space, self.event_bus = MovableClock(), Disk(), HoldingBus()
        self.free_space.bus = self.event_bus
        self.stick, self._mounts, self._undo = folder / "media" / "USB STICK", folder / "mounts", ExitStack()
        self.unmount()
        made = self.clock.wall() - timedelta(weeks=weeks_old)
        parts: dict[str, Any] = {
            "head": lambda head: with_all_chips(head, made),
            "store": {"free_bytes": self.free_space},
            "clock": self.clock,
            "event_bus": self.event_bus,
            "wait": False,
            "sticks": UsbDrives((folder / "media",), self._mounts),
            "carrier": uploads and HttpsUploader(UploadSettings.model_validate(uploads)),
        }
        self._binning = binning
        self.rig: Rig = rig_builder(small_template(binning), plans)(folder, self._undo, **parts | options)
        self._serve(self.rig)

    def _serve(self, rig: Rig) -> None:
        """Serve the application of a rig on a free port."""
        self.requests = RecordedRequests(rig.app)
        config = uvicorn.Config(self.requests, port=0, log_level="error", ws="none", timeout_graceful_shutdown=1)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, daemon=True)
        self._thread.start()
        until(lambda: self._server.started, 60)
        self.url = f"http://127.0.0.1:{self._server.servers[0].sockets[0].getsockname()[1]}"
        self._client = self._undo.enter_context(httpx.Client(base_url=self.url, timeout=60))

    def close(self) -> None:
        """Stop the server and release the head."""
        self.hold = None
        self.clock.gate.set()
        self.event_bus.close()  # ends the event streams, which would delay the shutdown
        self._server.should_exit = True
        self._thread.join(10)
        self._undo.close()

    def wait_until_ready(self) -> None:
        assert self.rig.exam.ready.wait(300), "a busy computer makes plans for minutes"

    @property
    def presses(self) -> int:
        """The number of captures that pages have requested."""
        return self.requests.presses

    @property
    def hold(self) -> str | None:
        """The stage at which captures are held, or None."""
        return self.event_bus.hold

    @hold.setter
    def hold(self, stage: str | None) -> None:
        self.event_bus.hold = stage

    def request(self, method: str, path: str, **body: Any) -> Any:
        """Send a request from outside the page, with an idempotency key; return the JSON answer."""
        content = {"json": {"key": secrets.token_hex(8), **body}} if method != "GET" else {}
        answer = self._client.request(method, path, **content)
        assert answer.is_success, answer.text
        return answer.json()

    def begin_visit(self, number: str | None = None, **fields: Any) -> dict[str, Any]:
        """Begin a visit with these form fields and return it."""
        visit = self.request("POST", "/api/visits", **({"number": number} if number else {}))
        for field, value in fields.items():
            visit = self.record(visit["id"], field, value)
        return dict(visit)

    def record(self, visit: str, field: str, value: Any) -> dict[str, Any]:
        """Record one form field and return the visit."""
        return dict(self.request("PATCH", f"/api/visits/{visit}", field=field, value=value))

    def visit(self, id: str | None = None) -> dict[str, Any]:
        """Return a visit, by default the newest."""
        return dict(self.request("GET", f"/api/visits/{id}") if id else self.visits()[0])

    def visits(self) -> list[dict[str, Any]]:
        """Return all visits, the newest first."""
        return list(self.request("GET", "/api/visits?limit=100")["visits"])

    def press(self, visit: str, slot: str = "R-centre") -> dict[str, Any]:
        """Take a picture from outside the page and return the capture."""
        eye = "OD" if slot[0] == "R" else "OS"
        return dict(self.request("POST", "/api/captures", eye=eye, visit=visit, slot=slot))

    def finish(self, visit: str) -> dict[str, Any]:
        """Finish a visit and return it."""
        return dict(self.request("POST", f"/api/visits/{visit}/finish"))

    def wait_for_problem(self, code: str | None, before_each: Callable[[], None] = lambda: None) -> dict[str, Any]:
        """Request live pictures until the status has a problem with this code; return the problem, empty for None.

        `before_each` is called before each request.
        """
        problem: dict[str, Any] = {"code": "unknown"}

        def is_there() -> bool:
            nonlocal problem
            before_each()
            # Not over HTTP: an open page may hold the control lease. In a thread: this one has an event loop.
            with ThreadPoolExecutor(1) as pool:
                pool.submit(live_picture, self.rig.exam, 0, wanted=LiveRequest(("OD",))).result()
            problem = self.request("GET", "/api/status")["problem"] or {}
            return problem.get("code") == code

        until(is_there, 30)
        return problem

    def publish_alerts(self) -> None:
        """Read the alerts now, not at the next reading of their monitor."""
        self.rig.application.alerts.publish_changes()

    @contextmanager
    def poor_light(self, cause: str) -> Iterator[None]:
        """Show a scene of POOR within the context."""
        self.show(cause)
        yield
        self.show(None)

    def show(self, cause: str | None) -> None:
        """Show a scene of POOR from now on; None: the good scene."""
        self.rig.world.eyes = (poor_world(cause, self._binning) if cause else small_template(self._binning)[0]).eyes

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """Stop the server within the context: connections stay open, no answer or event is sent."""
        over = threading.Event()
        loop = self._server.servers[0].get_loop()
        loop.call_soon_threadsafe(lambda: over.wait(HELD_S))
        yield
        over.set()

    def mount(self) -> None:
        """Mount the USB drive, as the kernel would list it."""
        self.stick.mkdir(parents=True, exist_ok=True)
        name = str(self.stick).replace(" ", "\\040")
        self._mounts.write_text(f"/dev/sda1 {name} vfat rw 0 0\n")

    def unmount(self) -> None:
        """Unmount the USB drive."""
        self._mounts.write_text("proc /proc proc rw 0 0\n")


class Uncalibrated(Real):
    """Running instrument that cannot open its head: without calibration, or with another diffuser (`is_mismatched`)."""

    def __init__(self, folder: Path, plans: Path, is_mismatched: bool = False) -> None:
        self._is_mismatched = is_mismatched
        super().__init__(folder, plans)

    def _serve(self, rig: Rig) -> None:
        def open_exam() -> ExamService:
            if self._is_mismatched:
                rig.world.identity = HeadIdentity("D-7", "another-calibration")
                refuse_mismatched_head(replace(rig.exam.head, chips=Chips(memory=SimHeadMemory(rig.world))))
            table = CalibrationTable(archive=rig.store.folder / "empty")
            open_head(rig.world.spec.model_copy(update={"calibration": table}), rig.clock, MemoryLedger(rig.clock))
            raise AssertionError("the head was not refused")

        context = replace(rig.arbiter.context, archive=Archive(rig.store.folder / "nothing"))
        arbiter = HeadArbiter(context, open_exam, lambda: open_bench(rig.world.spec, rig.clock))
        self._undo.callback(arbiter.close)
        super()._serve(replace(rig, arbiter=arbiter, build_application=partial(create_app, arbiter, rig.authenticator)))


class Instruments:
    """Instruments of this process, each with a data folder of its own; the next one makes its plans while a test runs.

    All are built in the thread of the tests: FastAPI changes the process-wide list of ignored warnings.
    """

    def __init__(self, new_folder: Callable[[], Path]) -> None:
        self._new_folder, self._plans = new_folder, new_folder()
        self._empty_store = new_folder() / "store"
        CaptureStore(self._empty_store).close()
        self._next: Real | None = None

    def new_folder(self) -> Path:
        """Return a folder with an empty store, whose schema is made already."""
        folder = self._new_folder()
        copy_store(self._empty_store, folder)
        return folder

    def build(self, kind: type[Real] = Real, folder: Path | None = None, **options: Any) -> Real:
        """Return a new instrument, which is ready."""
        real = kind(folder or self.new_folder(), self._plans, **options)
        real.wait_until_ready()
        return real

    def take(self) -> Real:
        """Return the instrument that was built ahead, and build another, which makes its plans meanwhile."""
        ahead = self._next or Real(self.new_folder(), self._plans)
        ahead.wait_until_ready()
        self._next = Real(self.new_folder(), self._plans)
        return ahead

    def close(self) -> None:
        """Release the instrument that no test has used."""
        if self._next is not None:
            self._next.wait_until_ready()
            self._next.close()


def copy_store(store: Path, folder: Path) -> None:
    """Copy a capture store into the folder of another instrument, as it is at this moment."""
    shutil.copytree(store, folder / "store", dirs_exist_ok=True)
