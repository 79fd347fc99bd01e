"""Fixtures: a small simulated instrument built by constructor arguments, an HTTP client and the command."""

import asyncio
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Coroutine, Iterator, Mapping
from contextlib import ExitStack
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from threading import Event
from typing import Any

import httpx
import pytest
from fastapi import FastAPI

from device.calibration.archive import Archive
from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.head import Head, hazard_of, open_bench
from device.light_safety.guard import GuardedLight
from device.ports import Camera
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.render import crop_or_pad
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Calibration, Colour, Psf
from services.delivery.uploader import Uploader
from services.delivery.usb_drives import UsbDrive, UsbDrives
from services.http.app import Application, create_app
from services.http.authentication import Authenticator
from services.instrument.events import EventBus
from services.instrument.exam import ExamService
from services.instrument.head_arbiter import AppContext, HeadArbiter
from services.instrument.watchdog import Watchdog
from services.records.capture import BUDGET_S
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.programme import Programme, load_programme
from services.records.visit_repository import VisitRepository
from tests.simulated import small_head_toml

ROOT = Path(__file__).parents[2]
DAY_S = 86400.0
COMMAND = str(Path(sys.executable).parent / "diffuscope")
SMALL_HEAD = small_head_toml("Small simulated head")


class GateClock(VirtualClock):
    """Virtual clock whose `sleep` blocks while the gate is closed, and the lamp of `world` is on."""

    world: World | None = None

    def __init__(self) -> None:
        super().__init__()
        self.gate = Event()
        self.gate.set()
        self.is_sleeping = Event()

    def sleep(self, duration_s: float) -> None:
        if self.world is None or self.world.illumination is not None:
            self.is_sleeping.set()
            assert self.gate.wait(30)
        super().sleep(duration_s)


@dataclass
class Rig:
    """Simulated instrument with references to its parts."""

    world: World
    clock: GateClock
    store: CaptureStore
    event_bus: EventBus
    exam: ExamService
    arbiter: HeadArbiter
    authenticator: Authenticator
    build_application: Callable[[], Application]
    died: Event = field(default_factory=Event)

    @cached_property
    def application(self) -> Application:
        """The application; built at the first use, because its 67 routes take longer than many a test."""
        return self.build_application()

    @property
    def app(self) -> FastAPI:
        """The ASGI application."""
        return self.application.http

    def published_events(self) -> list[tuple[str, Mapping[str, Any]]]:
        """Return kind and data of every event in the buffer."""
        return [(event.kind, event.data) for event in self.event_bus.history]

    def block_exposures(self) -> None:
        """Block every following exposure in light until the gate is opened."""
        self.clock.gate.clear()
        self.clock.is_sleeping.clear()

    def wait_for_blocked_exposure(self) -> None:
        assert self.clock.is_sleeping.wait(10)

    def ask(self, use_client: Callable[[httpx.AsyncClient], Coroutine[Any, Any, Any]], **options: Any) -> Any:
        """Run a coroutine with an HTTP client of the application in this process; return its result."""

        async def run() -> Any:
            transport = httpx.ASGITransport(app=self.app, **options)
            own = {"Sec-Fetch-Site": "same-origin"}  # header of a same-origin page
            async with httpx.AsyncClient(
                transport=transport, base_url="http://diffuscope.local", timeout=30, headers=own
            ) as client:
                return await use_client(client)

        return asyncio.run(run())

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        answer: httpx.Response = self.ask(lambda client: client.request(method, path, **options))
        return answer


@pytest.fixture(scope="session")
def head_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("head") / "small.toml"
    path.write_text(SMALL_HEAD)
    return path


@pytest.fixture(scope="session")
def served_head(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a head for servers in a process of their own: with half the rows and columns they start sooner."""
    path = tmp_path_factory.mktemp("head") / "served.toml"
    path.write_text(small_head_toml("Served simulated head", summed=2))
    return path


@pytest.fixture(scope="session")
def spec(head_file: Path) -> InstrumentSpec:
    return load_head(head_file)


@pytest.fixture(scope="session")
def plans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("plans")


@pytest.fixture(scope="session")
def template(spec: InstrumentSpec) -> tuple[World, Calibration]:
    return coarsened(spec)


def coarsened(spec: InstrumentSpec) -> tuple[World, Calibration]:
    """Return the traced world and calibration of the small head with binned pixels (2 x 2)."""
    coarse = {"rows": 135, "cols": 240, "pitch_um": 2 * spec.camera.pitch_um}
    return traced_world(spec.model_copy(update={"camera": spec.camera.model_copy(update=coarse)}))


def traced_world(spec: InstrumentSpec) -> tuple[World, Calibration]:
    """Return a world with precomputed illumination, and its calibration; shared by all tests."""
    world = World(spec, VirtualClock())
    for colour in (spec.light.colour, spec.light.preview_colour):
        world.electrons_per_s(colour)
    return world, simulated_calibration(world)


MakeRig = Callable[..., Rig]


@pytest.fixture(scope="session")
def build(template: tuple[World, Calibration], plans: Path) -> Callable[..., Rig]:
    return rig_builder(template, plans)


def rig_builder(template: tuple[World, Calibration], plans: Path) -> Callable[..., Rig]:
    """Return a factory of rigs: `camera` wraps the camera, `head` changes the head, `max_on_s` limits the lamp."""
    dark_world, calibration = template

    def build_rig(
        folder: Path,
        undo: ExitStack,
        camera: Callable[[Camera], Camera] = lambda camera: camera,
        max_on_s: float = 30.0,
        store: dict[str, Any] | None = None,
        event_bus: EventBus | None = None,
        wait: bool = True,
        psfs: int = 1,
        tinted: tuple[Colour, ...] = (),
        watchdog: str | None = None,
        head: Callable[[Head], Head] = lambda head: head,
        clock: GateClock | None = None,
        carrier: Uploader | None = None,
        sticks: UsbDrives | None = None,
        programme: Programme | None = None,
    ) -> Rig:
        clock, died = clock or GateClock(), Event()
        scene = copy(dark_world)
        scene.clock, scene.faults = clock, set()
        records = undo.enter_context(CaptureStore(folder / "store", **{"reserve_bytes": 0, **(store or {})}))
        light = GuardedLight(
            SimLight(scene),
            clock,
            max_on_s,
            hazard_of(scene.spec),
            DoseLedgerStore(records.engine, clock, DAY_S, boot="once"),
        )
        stack = replace(calibration, psfs=calibration.psfs * psfs)
        if tinted:
            own = tuple(Psf(crop_or_pad(scene.psf(colour), scene.shape), colour, colour) for colour in tinted)
            stack = replace(calibration, psfs=own)
        opened = head(Head(scene.spec, camera(SimCamera(scene)), light, stack, present_eye=scene.present_eye))
        event_bus = event_bus or EventBus()
        pictures = VisitRepository(records.engine, programme or load_programme(), clock).pictures
        exam = ExamService(
            opened,
            records,
            event_bus,
            clock,
            plans,
            died.set,
            Watchdog(watchdog),
            lambda: BUDGET_S,
            pictures.resumed_target,
        )
        undo.callback(exam.close)
        undo.callback(clock.gate.set)
        assert not wait or exam.ready.wait(60)
        context = AppContext(
            opened.spec, Archive(folder / "archive"), records, event_bus, clock, Watchdog(watchdog), died.set
        )
        owner = HeadArbiter(context, lambda: exam, lambda: open_bench(scene.spec, clock))
        door = Authenticator(folder / "access", clock, has_demo=True)
        # Virtual time stands still, so that tests would reach the limits in rate.
        build_app = partial(
            create_app, owner, door, programme, uploader=carrier, usb_drives=sticks, rates={}, system=folder / "system"
        )
        clock.world = scene
        return Rig(scene, clock, records, event_bus, exam, owner, door, build_app, died)

    return build_rig


@pytest.fixture
def make_rig(build: Callable[..., Rig], tmp_path: Path) -> Iterator[MakeRig]:
    with ExitStack() as undo:
        yield partial(build, tmp_path, undo)


@pytest.fixture
def rig(make_rig: MakeRig) -> Rig:
    return make_rig()


@pytest.fixture(scope="module")
def lasting_rig(build: Callable[..., Rig], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with ExitStack() as undo:
        yield build(tmp_path_factory.mktemp("lasting"), undo)


@pytest.fixture
def old_rig(lasting_rig: Rig) -> Iterator[Rig]:
    """A rig shared by a module, because planning takes a second; afterwards it has no fault and its lamp is off."""
    yield lasting_rig
    lasting_rig.world.faults.clear()
    lasting_rig.clock.gate.set()
    until(lambda: lasting_rig.world.illumination is None)
    assert not lasting_rig.died.is_set()


@pytest.fixture
def stick(tmp_path: Path) -> Path:
    """The folder of a mounted USB drive, whose name has a blank."""
    folder = tmp_path / "media" / "USB STICK"
    folder.mkdir(parents=True)
    escaped = str(folder).replace(" ", "\\040")  # as the kernel writes a blank
    (tmp_path / "mounts").write_text(f"proc /proc proc rw 0 0\n/dev/sda1 {escaped} vfat rw 0 0\n")
    return folder


def drive_id(folder: Path) -> str:
    """Return the identifier of the USB drive that is mounted at a folder."""
    return UsbDrive(folder, 0, True).id


@pytest.fixture
def drives(tmp_path: Path, stick: Path) -> UsbDrives:
    """The USB drives of an instrument: one, `stick`."""
    return UsbDrives((tmp_path / "media",), tmp_path / "mounts")


def technician_requests(rig: Rig, path: str) -> Callable[..., httpx.Response]:
    """Return a function for requests below `path`."""
    return lambda method, below="", **more: rig.request(method, f"{path}{below}", **more)


def until(holds: Callable[[], bool], patience_s: float = 60.0) -> None:
    """Wait in real time for a condition set by another thread."""
    end = time.monotonic() + patience_s
    while not holds():
        assert time.monotonic() < end, "timeout"
        time.sleep(0.005)


@pytest.fixture
def wait_until() -> Callable[..., None]:
    return until


async def read_event_stream(
    app: FastAPI,
    enough: Callable[[list[tuple[int | None, str, dict[str, Any]]]], bool],
    headers: dict[str, str] | None = None,
    begin: Callable[[], None] = lambda: None,
) -> list[tuple[int | None, str, dict[str, Any]]]:
    """Read the event stream like a browser until `enough` holds, then disconnect; `begin` is called once it is open."""
    done, text = asyncio.Event(), ""
    received: list[tuple[int | None, str, dict[str, Any]]] = []

    async def receive() -> dict[str, Any]:
        await done.wait()
        return {"type": "http.disconnect"}

    async def send(message: Any) -> None:
        nonlocal text
        if message["type"] == "http.response.start":
            assert message["status"] == 200
            return
        if not received and message["body"]:
            begin()
        text += message["body"].decode()
        *whole, text = text.split("\n\n")
        received.extend(parsed(block) for block in whole)
        if enough(received):
            done.set()

    scope = {
        "type": "http",
        "asgi": {"version": "3.0", "spec_version": "2.3"},
        "http_version": "1.1",
        "method": "GET",
        "scheme": "http",
        "path": "/api/events",
        "raw_path": b"/api/events",
        "query_string": b"",
        "root_path": "",
        "headers": [(key.lower().encode(), value.encode()) for key, value in (headers or {}).items()],
        "server": ("eye", 80),
        "client": ("127.0.0.1", 1),
    }
    await asyncio.wait_for(app(scope, receive, send), 20)
    return received


def parsed(block: str) -> tuple[int | None, str, dict[str, Any]]:
    fields = dict(line.split(": ", 1) for line in block.splitlines())
    return int(fields["id"]) if "id" in fields else None, fields["event"], json.loads(fields["data"])


@pytest.fixture
def read_events() -> Callable[..., Any]:
    return lambda *args, **options: asyncio.run(read_event_stream(*args, **options))


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment of test processes, with temporary cache and data folders."""
    home = tmp_path_factory.mktemp("home")
    return os.environ | {"XDG_CACHE_HOME": str(home / "cache"), "XDG_DATA_HOME": str(home / "data")}


Diffuscope = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def diffuscope(environment: dict[str, str]) -> Diffuscope:
    """Run the command `diffuscope` as a process."""

    def run(*words: object) -> subprocess.CompletedProcess[str]:
        command = [COMMAND, *map(str, words)]
        return subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=60, check=False
        )

    return run
