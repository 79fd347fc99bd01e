"""Bring the parts together and serve them: socket first, so that a port in use is said before anything is opened."""

import errno
import logging
import os
import signal
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from importlib.metadata import version
from pathlib import Path
from threading import Event
from types import FrameType
from typing import Self

import uvicorn

from device.calibration.archive import Archive
from device.clock import SystemClock
from device.dose import light_limits
from device.errors import DiffuscopeError, InputError
from device.head import open_bench, open_head
from device.spec import InstrumentSpec
from services.instrument.api import create_app
from services.instrument.bulletin import Bulletin
from services.instrument.carrier import Carrier
from services.instrument.diary import Diary
from services.instrument.diary_api import diary_routes
from services.instrument.exam import Exam
from services.instrument.explorer import Explorer
from services.instrument.explorer_api import explorer_routes
from services.instrument.exporting import Sticks
from services.instrument.forgery import own_names
from services.instrument.owner import House, Owner, archive_of, calibrated
from services.instrument.technician import Door
from services.instrument.updates_api import update_routes
from services.instrument.updating import UpdateDesk
from services.instrument.watchdog import Watchdog
from services.records.light_book import LightBook
from services.records.protocol import Protocol
from services.records.store import Store

log = logging.getLogger(__name__)

BACKLOG = 128
HANDED_OVER = 3  # the file descriptor of sd_listen_fds(3)
STOPPED_BY = (signal.SIGTERM, signal.SIGINT)


def bound(host: str, port: int) -> socket.socket:
    """A listening address of our own; InputError if it cannot be had.

    It listens at once: two that are only bound could share an address, and a page that asks early is kept waiting.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with ExitStack() as undo:
            listener = undo.enter_context(socket.socket(family, socket.SOCK_STREAM))
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((host, port))
            listener.listen(BACKLOG)
            undo.pop_all()
    except OSError as error:
        raise InputError(
            f"http://{host}:{port} cannot be served: {error.strerror or error}", _remedy(error, port)
        ) from error
    return listener


def handed_over(environment: Mapping[str, str]) -> socket.socket | None:
    """The listening address that systemd opened for this very process; None if it did not."""
    if environment.get("LISTEN_PID") != str(os.getpid()) or environment.get("LISTEN_FDS") != "1":
        return None
    return socket.socket(fileno=HANDED_OVER)


def _remedy(error: OSError, port: int) -> str:
    other = port + 1 if port < 65535 else 8000
    if error.errno == errno.EADDRINUSE:
        return f"Another program uses it, perhaps this one. Stop that, or choose another with --port {other}."
    if error.errno == errno.EACCES:
        return "Ports below 1024 belong to the system. Choose one with --port 8000."
    return "Give an address of this computer with --host: 127.0.0.1 for itself, 0.0.0.0 for the whole network."


def serve(
    spec: InstrumentSpec, address: socket.socket, data: Path, ready: Callable[[], None], watchdog: Watchdog,
    protocol: Protocol, names: tuple[str, ...] = (), updater: tuple[Path | None, Path | None] = (None, None),
    carrier: Carrier | None = None,
) -> None:  # fmt: skip
    """Open the head and the shelf, say `ready`, and serve the page at `address` until SIGTERM, SIGINT or a failure.

    The page is there while the exam still makes its plans; raises what keeps it from making them. It answers to
    `names`, beside its own and local ones. `updater`: its folder, and where it takes wishes; `carrier`: to a receiver.
    Whatever ends it, everything that was opened is closed. SystemExit(0) for a signal before the server was there.
    """
    clock = SystemClock()
    with _Stop() as stop, address, Store(data, clock=clock) as store, ExitStack() as undo:
        book = LightBook(store.engine, clock, light_limits().window_s)
        archive = Archive(archive_of(spec, data))
        diary = undo.enter_context(closing(Diary(data / "diary")))
        house = House(spec, archive, store, Bulletin(), clock, watchdog, stop.failed)
        explorer = Explorer(data / "explorer", data / "plans", clock, spec, house.bulletin.tell)

        def exam() -> Exam:
            head = open_head(calibrated(spec, archive.root), clock, book)
            return Exam(
                head, store, house.bulletin, clock, data / "plans", house.died, watchdog, lambda: explorer.budget_s
            )

        owner = Owner(house, exam, lambda: open_bench(spec, clock))
        undo.callback(owner.close)
        door, desk = Door(data / "technician.json", clock), UpdateDesk(*updater, clock, version("diffuscope"))
        rooms = [explorer_routes(explorer, store, lambda: owner.exam.head.calibration), update_routes(desk, door)]
        rooms.append(diary_routes(diary, Sticks(), clock))
        app = create_app(owner, door, protocol, own_names() + names, rooms=rooms, carrier=carrier)
        config = uvicorn.Config(app, log_level="warning", timeout_graceful_shutdown=1)
        log.info("started, version %s", app.version)
        if store.swept:
            log.warning("half-kept captures of the last run were moved to torn/: %s", ", ".join(store.swept))
        ready()
        stop.ending(_Server(config, house.bulletin)).run(sockets=[address])
    if owner.failure is not None or stop.has_failed:
        raise owner.failure or DiffuscopeError("the instrument stopped unexpectedly")


class _Stop:
    """Ends the server on SIGTERM, on SIGINT, or when the head has failed, so that every `close` runs afterwards.

    uvicorn handles the signals too, but raises them again once its server has ended, and SIGTERM then kills the
    process before anything is closed. A signal that comes before there is a server raises SystemExit(0) in the main
    thread; one that comes while everything is being closed changes nothing. The earlier handlers are restored at exit.
    """

    def __init__(self) -> None:
        self._failed = Event()
        self._server: uvicorn.Server | None = None

    def __enter__(self) -> Self:
        self._before = {number: signal.signal(number, self._stop) for number in STOPPED_BY}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    @property
    def has_failed(self) -> bool:
        """Whether `failed` was called."""
        return self._failed.is_set()

    def failed(self) -> None:
        """End the server, from any thread; systemd starts it anew."""
        self._failed.set()
        if self._server is not None:
            self._server.should_exit = True

    def ending(self, server: uvicorn.Server) -> uvicorn.Server:
        """The same server, which is the one to be ended from now on."""
        self._server = server
        if self._failed.is_set():
            server.should_exit = True
        return server

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self._server is None:
            raise SystemExit(0)
        self._server.handle_exit(number, frame)


class _Server(uvicorn.Server):
    """A server that tells its event streams to end before it waits for them."""

    def __init__(self, config: uvicorn.Config, bulletin: Bulletin) -> None:
        super().__init__(config)
        self._bulletin = bulletin

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave the signals to `_Stop`."""
        yield

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the streams, then what uvicorn does."""
        self._bulletin.close()
        await super().shutdown(sockets)
