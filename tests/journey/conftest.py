"""A small simulated instrument, built from its real parts by constructor arguments, and ways to talk to it."""

import asyncio
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import ExitStack
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

import httpx
import pytest
from fastapi import FastAPI

from device.calibration.archive import Archive
from device.clock import VirtualClock
from device.guard import GuardedLight
from device.head import Head, hazard_of, open_bench
from device.ports import Camera
from device.sim.calibrate import simulated_calibration
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.render import fitted
from device.sim.world import World
from device.spec import InstrumentSpec, load_head
from device.values import Calibration, Colour, Psf
from services.instrument.api import create_app
from services.instrument.bulletin import Bulletin
from services.instrument.carrier import Carrier
from services.instrument.exam import Exam
from services.instrument.exporting import Sticks
from services.instrument.owner import House, Owner
from services.instrument.technician import Door
from services.instrument.watchdog import Watchdog
from services.records.light_book import LightBook
from services.records.store import Store

ROOT = Path(__file__).parents[2]
DAY_S = 86400.0
COMMAND = str(Path(sys.executable).parent / "diffuscope")
SMALL_HEAD = """\
name = "Small simulated head"

[camera]
backend = "sim"
rows = 270
cols = 480
pitch_um = 20.16
full_well_e = 23000
read_noise_e = 1.03

[light]
backend = "sim"

[optics]
iris_um = 3200
diffuser_to_sensor_um = 6000
angular_magnification = 0.75
field_deg = 33.4

[sim]

[sim.object]
haemorrhages = 3
"""


class GateClock(VirtualClock):
    """Virtual time that passes only while its gate is open: what sleeps hangs until then."""

    def __init__(self) -> None:
        super().__init__()
        self.gate = Event()
        self.gate.set()
        self.someone_sleeps = Event()

    def sleep(self, duration_s: float) -> None:
        self.someone_sleeps.set()
        assert self.gate.wait(30)
        super().sleep(duration_s)


@dataclass
class Rig:
    """An instrument with everything a test may want to look at."""

    world: World
    clock: GateClock
    store: Store
    bulletin: Bulletin
    exam: Exam
    owner: Owner
    door: Door
    app: FastAPI
    died: Event = field(default_factory=Event)

    def told(self) -> list[tuple[str, dict[str, Any]]]:
        """Every event so far."""
        return [(event.kind, event.data) for event in self.bulletin._events]

    def hang(self) -> None:
        """From now on every exposure hangs until the gate is opened."""
        self.clock.gate.clear()
        self.clock.someone_sleeps.clear()

    def wait_for_hanging(self) -> None:
        assert self.clock.someone_sleeps.wait(10)

    def ask(self, story: Callable[[httpx.AsyncClient], Coroutine[Any, Any, Any]], **options: Any) -> Any:
        """Run a story told by a client of the application in this process."""

        async def told() -> Any:
            transport = httpx.ASGITransport(app=self.app, **options)
            own = {"Sec-Fetch-Site": "same-origin"}  # as a browser says of the instrument's own page
            async with httpx.AsyncClient(
                transport=transport, base_url="http://eye.local", timeout=30, headers=own
            ) as client:
                return await story(client)

        return asyncio.run(told())

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        answer: httpx.Response = self.ask(lambda client: client.request(method, path, **options))
        return answer


@pytest.fixture(scope="session")
def head_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("head") / "small.toml"
    path.write_text(SMALL_HEAD)
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
    """The small head, half as fine again."""
    coarse = {"rows": 135, "cols": 240, "pitch_um": 2 * spec.camera.pitch_um}
    return traced(spec.model_copy(update={"camera": spec.camera.model_copy(update=coarse)}))


def traced(spec: InstrumentSpec) -> tuple[World, Calibration]:
    """A world whose light is already traced, and its calibration: the same for every test."""
    world = World(spec, VirtualClock())
    for colour in (spec.light.colour, spec.light.preview_colour):
        world.electrons_per_s(colour)
    return world, simulated_calibration(world)


MakeRig = Callable[..., Rig]


@pytest.fixture(scope="session")
def build(template: tuple[World, Calibration], plans: Path) -> Callable[..., Rig]:
    return builder(template, plans)


def builder(template: tuple[World, Calibration], plans: Path) -> Callable[..., Rig]:
    """Build an instrument: `camera` wraps the simulated one, `max_on_s` is the guard's, `head` changes it."""
    dark_world, calibration = template

    def built(
        folder: Path,
        undo: ExitStack,
        camera: Callable[[Camera], Camera] = lambda camera: camera,
        max_on_s: float = 30.0,
        store: dict[str, Any] | None = None,
        bulletin: Bulletin | None = None,
        wait: bool = True,
        psfs: int = 1,
        tinted: tuple[Colour, ...] = (),
        watchdog: str | None = None,
        head: Callable[[Head], Head] = lambda head: head,
        clock: GateClock | None = None,
        carrier: Carrier | None = None,
        sticks: Sticks | None = None,
    ) -> Rig:
        clock, died = clock or GateClock(), Event()
        scene = copy(dark_world)
        scene.clock, scene.faults = clock, set()
        shelf = undo.enter_context(Store(folder / "shelf", **{"reserve_bytes": 0, **(store or {})}))
        light = GuardedLight(
            SimLight(scene), clock, max_on_s, hazard_of(scene.spec), LightBook(shelf.engine, clock, DAY_S, boot="once")
        )
        stack = replace(calibration, psfs=calibration.psfs * psfs)
        if tinted:
            own = tuple(Psf(fitted(scene.psf(colour), scene.shape), colour, colour) for colour in tinted)
            stack = replace(calibration, psfs=own)
        opened = head(Head(scene.spec, camera(SimCamera(scene)), light, stack, facing=scene.meet))
        bulletin = bulletin or Bulletin()
        exam = Exam(opened, shelf, bulletin, clock, plans, died.set, Watchdog(watchdog))
        undo.callback(exam.close)
        undo.callback(clock.gate.set)
        assert not wait or exam.ready.wait(60)
        house = House(scene.spec, Archive(folder / "archive"), shelf, bulletin, clock, Watchdog(watchdog), died.set)
        owner = Owner(house, lambda: exam, lambda: open_bench(scene.spec, clock))
        door = Door(folder / "technician.json", clock)
        app = create_app(owner, door, carrier=carrier, sticks=sticks)
        return Rig(scene, clock, shelf, bulletin, exam, owner, door, app, died)

    return built


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
    """An instrument that has been used before: planning a new one takes a second. It is well and dark afterwards."""
    yield lasting_rig
    lasting_rig.world.faults.clear()
    lasting_rig.clock.gate.set()
    until(lambda: lasting_rig.world.glow is None)
    assert not lasting_rig.died.is_set()


def until(holds: Callable[[], bool], patience_s: float = 15.0) -> None:
    """Wait for another thread; real time, because threads need it."""
    end = time.monotonic() + patience_s
    while not holds():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.005)


@pytest.fixture
def wait_until() -> Callable[..., None]:
    return until


async def follow(
    app: FastAPI,
    enough: Callable[[list[tuple[int | None, str, dict[str, Any]]]], bool],
    headers: dict[str, str] | None = None,
    begin: Callable[[], None] = lambda: None,
) -> list[tuple[int | None, str, dict[str, Any]]]:
    """Read the event stream as a browser would, until there is enough, then go away; calls `begin` once it is open."""
    done, text = asyncio.Event(), ""
    heard: list[tuple[int | None, str, dict[str, Any]]] = []

    async def receive() -> dict[str, Any]:
        await done.wait()
        return {"type": "http.disconnect"}

    async def send(message: Any) -> None:
        nonlocal text
        if message["type"] == "http.response.start":
            assert message["status"] == 200
            return
        if not heard and message["body"]:
            begin()
        text += message["body"].decode()
        *whole, text = text.split("\n\n")
        heard.extend(parsed(block) for block in whole)
        if enough(heard):
            done.set()

    scope = {
        "type": "http", "asgi": {"version": "3.0", "spec_version": "2.3"}, "http_version": "1.1", "method": "GET",
        "scheme": "http", "path": "/api/events", "raw_path": b"/api/events", "query_string": b"", "root_path": "",
        "headers": [(key.lower().encode(), value.encode()) for key, value in (headers or {}).items()],
        "server": ("eye", 80), "client": ("page", 1),
    }  # fmt: skip
    await asyncio.wait_for(app(scope, receive, send), 20)
    return heard


def parsed(block: str) -> tuple[int | None, str, dict[str, Any]]:
    fields = dict(line.split(": ", 1) for line in block.splitlines())
    return int(fields["id"]) if "id" in fields else None, fields["event"], json.loads(fields["data"])


@pytest.fixture
def read_events() -> Callable[..., Any]:
    return lambda *args, **options: asyncio.run(follow(*args, **options))


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The processes' own: caches and captures of a test do not go to the home of whoever runs it."""
    home = tmp_path_factory.mktemp("home")
    return os.environ | {"XDG_CACHE_HOME": str(home / "cache"), "XDG_DATA_HOME": str(home / "data")}


Diffuscope = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def diffuscope(environment: dict[str, str]) -> Diffuscope:
    """Run one command as a process."""

    def run(*words: object) -> subprocess.CompletedProcess[str]:
        command = [COMMAND, *map(str, words)]
        return subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=60, check=False
        )

    return run
