"""A complete simulated instrument behind the HTTP application: virtual time, temporary folders, no network."""

import asyncio
import io
import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Any

import httpx
import numpy as np
from fastapi import FastAPI
from numpy.typing import NDArray

from device.calibration.archive import Archive
from device.clock import VirtualClock
from device.config.head_file import CalibrationTable, InstrumentSpec, load_head
from device.errors import CameraMissing
from device.head import Bench, Head, open_bench, open_head
from device.ports import Camera
from device.values import ExposureSettings, Frame
from services.backup.backup_runner import BackupRunner
from services.delivery.uploader import Uploader, VisitArchive
from services.delivery.usb_drives import UsbDrive, UsbDrives
from services.errors import UploadRejected
from services.health.event_log import EventLog
from services.http.app import Application, create_app
from services.http.authentication import Authenticator
from services.http.routes.accuracy import accuracy_routes
from services.http.routes.backup import backup_routes
from services.http.routes.erasure import erasure_routes
from services.http.routes.event_log import event_log_routes
from services.http.routes.updates import update_routes
from services.instrument.accuracy_explorer import AccuracyExplorer
from services.instrument.events import EventBus
from services.instrument.exam import ExamService
from services.instrument.head_arbiter import AppContext, HeadArbiter, archive_path, with_calibration
from services.instrument.update_requests import UpdateRequests
from services.instrument.watchdog import Watchdog
from services.records.audit_log import AuditLog
from services.records.capture_store import CaptureStore
from services.records.capture_target import TEST_PICTURE
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.upload_queue import UploadReceipt
from services.research.frontier import measure_scene
from tests.simulated import small_head_toml
from tests.updates import Board

DAY_S = 86400.0
PATIENCE_S = 120.0
PACE, LONGEST_PAUSE_S = 5.0, 0.02
FREE_BYTES = 10**12
TABLES = """\
[bus]
backend = "sim"
thermometer = 0x48
battery = 0x36
memory = 0x50

[sim]

[sim.object]
haemorrhages = 3

[sim.sensor]
prnu = 0.01
dsnu_e = 2.0
hot_pixels = 0.0003
"""
HEAD = small_head_toml("Golden head", TABLES, summed=2)
Heard = Callable[[list[dict[str, Any]]], bool]


class PacedClock(VirtualClock):
    """Virtual time, limited to PACE times real time while a thread polls.

    Faster, a lease or a pause would expire between two requests of a transcript on a busy machine.
    """

    def sleep(self, duration_s: float) -> None:
        """Advance the clock by `duration_s`, after a short real pause."""
        time.sleep(min(max(0.0, duration_s) / PACE, LONGEST_PAUSE_S))
        super().sleep(duration_s)


@dataclass
class BreakableCamera:
    """A camera that stops answering while `broken`."""

    inner: Camera
    broken: bool = False

    @property
    def shape(self) -> tuple[int, int]:
        return self.inner.shape

    def expose(self, shot: ExposureSettings, into: NDArray[np.uint16] | None = None) -> Frame:
        if self.broken:
            raise CameraMissing("the camera was unplugged")
        return self.inner.expose(shot, into)

    def prepare(self, shot: ExposureSettings) -> None:
        self.inner.prepare(shot)

    def close(self) -> None:
        self.inner.close()


@dataclass
class Refusing:
    """A receiver that refuses uploads while `refuses`."""

    refuses: bool = True
    kept: list[str] = field(default_factory=list)

    def upload(self, archive: VisitArchive, pause: Callable[[], None]) -> UploadReceipt:
        if self.refuses:
            raise UploadRejected("the receiver answers 403 Forbidden")
        self.kept.append(archive.name)
        return UploadReceipt(archive.sha256, "length")

    def abort(self) -> None:
        pass


@dataclass
class Instrument:
    """The application and the parts that a transcript changes from outside."""

    application: Application
    folder: Path
    clock: VirtualClock
    owner: HeadArbiter
    store: CaptureStore
    board: Board
    cameras: list[BreakableCamera]
    explorer: AccuracyExplorer
    cookies: httpx.Cookies = field(default_factory=httpx.Cookies)

    @property
    def app(self) -> FastAPI:
        """The ASGI application."""
        return self.application.http

    @property
    def stick(self) -> Path:
        """The one USB drive present."""
        return self.folder / "media" / "STICK"

    @property
    def stick_id(self) -> str:
        """Identifier of the USB drive in the list of the drives."""
        return UsbDrive(self.stick, 0, True).id

    def send(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Send one request to the application in this process; keep its cookies."""
        headers = {"Sec-Fetch-Site": "same-origin"} | options.pop("headers", {})

        async def sent() -> httpx.Response:
            transport = httpx.ASGITransport(app=self.app)
            async with httpx.AsyncClient(
                transport=transport, base_url="http://eye.local", cookies=self.cookies, timeout=60
            ) as client:
                answer = await client.request(method, path, headers=headers, **options)
                self.cookies = client.cookies
                return answer

        return asyncio.run(sent())

    def follow(self, enough: Heard, after: int | None = None) -> list[dict[str, Any]]:
        """Read `/api/events` as a browser does, until `enough`; return number, kind and data of each event."""
        return asyncio.run(_followed(self.app, enough, after))


async def _followed(app: FastAPI, enough: Heard, after: int | None) -> list[dict[str, Any]]:
    done, heard, text = asyncio.Event(), list[dict[str, Any]](), io.StringIO()
    last = [] if after is None else [(b"last-event-id", str(after).encode())]

    async def receive() -> dict[str, Any]:
        await done.wait()
        return {"type": "http.disconnect"}

    async def send(message: Any) -> None:
        text.write(message.get("body", b"").decode())
        heard[:] = [_parsed(block) for block in text.getvalue().split("\n\n")[:-1]]
        if heard and enough(heard):
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
        "headers": [(b"host", b"eye.local"), *last],
        "server": ("eye.local", 80),
        "client": ("127.0.0.1", 1),
    }
    await asyncio.wait_for(app(scope, receive, send), 60)
    return heard


def _parsed(block: str) -> dict[str, Any]:
    lines = dict(line.split(": ", 1) for line in block.splitlines())
    return lines | {"data": json.loads(lines["data"])}


@cache
def _plans() -> TemporaryDirectory[str]:
    """Return the folder of FFT plans, one per process: measuring plans takes seconds."""
    return TemporaryDirectory()


@contextmanager
def instrument(calibrated_before: bool = True, carrier: Uploader | None = None) -> Iterator[Instrument]:
    """Build an instrument in a temporary folder with all parts of `diffuscope run`; close it at the end.

    With `calibrated_before` false, the head file names an empty calibration archive: no picture can be taken, and the
    instrument is ready at once.
    """
    with TemporaryDirectory() as temporary, ExitStack() as undo:
        folder, clock = Path(temporary).resolve(), PacedClock()
        (folder / "head.toml").write_text(HEAD)
        spec = load_head(folder / "head.toml")
        if not calibrated_before:
            spec = spec.model_copy(update={"calibration": CalibrationTable(archive=folder / "archive")})
        store = undo.enter_context(
            CaptureStore(folder / "data", clock=clock, reserve_bytes=0, free_bytes=lambda _: FREE_BYTES)
        )
        owner, cameras, explorer = _owner(folder, spec, clock, store, undo)
        undo.callback(owner.close)
        sticks, board = _sticks(folder), Board.new(folder / "board")
        door = Authenticator(folder / "access", clock, has_demo=True)
        event_log = EventLog(folder / "event-log")
        undo.callback(event_log.close)
        desk = UpdateRequests(board.state, board.requests, clock, "1.0")
        backups = BackupRunner(folder / "data", lambda: owner.is_idle, clock)
        undo.callback(backups.close)
        rooms = [
            accuracy_routes(explorer, store, lambda: owner.exam.head.calibration),
            update_routes(desk),
            event_log_routes(event_log, sticks, clock),
            backup_routes(backups, store, sticks, clock),
            erasure_routes(owner, backups),
        ]
        application = create_app(
            owner,
            door,
            host_names=("eye.local",),
            usb_drives=sticks,
            technician_routers=rooms,
            uploader=carrier,
            audit_log=AuditLog(folder / "data", b"k" * 32, clock),
            system=folder / "system",
        )
        if calibrated_before:
            assert owner.exam.ready.wait(120)
        yield Instrument(application, folder, clock, owner, store, board, cameras, explorer)


def _owner(
    folder: Path, spec: InstrumentSpec, clock: VirtualClock, store: CaptureStore, undo: ExitStack
) -> tuple[HeadArbiter, list[BreakableCamera], AccuracyExplorer]:
    root, bulletin, cameras, benches = archive_path(spec, folder), EventBus(), list[BreakableCamera](), list[Bench]()
    plans = Path(_plans().name)
    house = AppContext(spec, Archive(root), store, bulletin, clock, Watchdog(None), Event().set)
    book = DoseLedgerStore(store.engine, clock, DAY_S, boot="once")
    coarse = spec.camera.model_copy(update={"rows": 68, "cols": 120, "pitch_um": 2 * spec.camera.pitch_um})
    measured = spec.model_copy(update={"camera": coarse})  # for the explorer: a quarter of the time
    explorer = AccuracyExplorer(folder / "accuracy", plans, clock, measured, bulletin.publish, measure_scene)

    def exam() -> ExamService:
        head: Head = open_head(with_calibration(spec, root), clock, book)
        cameras.append(BreakableCamera(head.camera))
        return ExamService(
            replace(head, camera=cameras[-1]),
            store,
            bulletin,
            clock,
            plans,
            house.on_failure,
            Watchdog(None),
            lambda: explorer.budget_s,
            lambda _: TEST_PICTURE,
        )

    def bench() -> Bench:
        benches.append(opened := open_bench(spec, clock))
        assert opened.world is not None
        opened.world.frames = 1000 * len(benches)  # the noise of a second calibration differs from that of the first
        return opened

    return HeadArbiter(house, exam, bench), cameras, explorer


def _sticks(folder: Path) -> UsbDrives:
    stick, mounts = folder / "media" / "STICK", folder / "mounts"
    stick.mkdir(parents=True)
    mounts.write_text(f"proc /proc proc rw 0 0\n/dev/sda1 {stick} vfat rw 0 0\n")
    return UsbDrives((folder / "media",), mounts)


def until(holds: Callable[[], bool]) -> None:
    """Wait in real time, for another thread; fails after PATIENCE_S."""
    end_s = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end_s, "it did not happen"
        time.sleep(0.02)
