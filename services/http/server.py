"""Server process: bind the socket, open store and head, and run uvicorn until a signal or a failure.

The socket is bound first, so that a port in use is an error before any file or device is opened.
"""

import errno
import logging
import os
import signal
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from threading import Event
from types import FrameType
from typing import Self

import uvicorn
from fastapi import FastAPI

from device.calibration.archive import Archive
from device.clock import Clock, SystemClock
from device.config.head_file import InstrumentSpec
from device.errors import DiffuscopeError, InputError
from device.head import open_bench, open_head
from device.light_safety.hazard import light_limits
from services.backup.backup_runner import BackupRunner
from services.delivery.uploader import Uploader
from services.delivery.usb_drives import UsbDrives
from services.errors import StoreDamaged
from services.health.event_log import EventLog
from services.http.app import create_app
from services.http.authentication import OWN_SCREEN, Authenticator
from services.http.client_limits import Client
from services.http.connection_limits import ConnectionLimits, ConnectionTable, LimitedConfig, LimitedListener
from services.http.log_rate import LOGGER_NAMES, LogRateLimit
from services.http.routes.accuracy import accuracy_routes
from services.http.routes.backup import backup_routes
from services.http.routes.erasure import erasure_routes
from services.http.routes.event_log import event_log_routes
from services.http.routes.updates import update_routes
from services.http.security import own_host_names
from services.identity.audit_key import load_or_create_audit_key
from services.identity.users import FOLDER, UserTable
from services.instrument.accuracy_explorer import AccuracyExplorer, Measure
from services.instrument.allocator import return_freed_arrays
from services.instrument.events import EventBus
from services.instrument.exam import ExamService
from services.instrument.head_arbiter import AppContext, HeadArbiter, archive_path, with_calibration
from services.instrument.update_requests import UpdateRequests
from services.instrument.watchdog import Watchdog
from services.records.audit_log import AuditLog
from services.records.capture_store import CaptureStore
from services.records.device_identity import load_or_create_device, read_device
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.earlier_stores import refuse_earlier_store
from services.records.programme import Programme
from services.records.read_only_store import opened_store
from services.records.schema import DATABASE
from services.records.visit_repository import VisitRepository

log = logging.getLogger(__name__)

ACCEPTS = 16  # connections accepted between two steps of the event loop
LISTEN_QUEUE = 2048  # connections in the kernel until they are accepted; beyond it, a client tries again after 1 s
SD_LISTEN_FD = 3  # the file descriptor of sd_listen_fds(3)
CIPHERS = "ECDHE+AESGCM:ECDHE+CHACHA20"  # of TLS 1.2; those of 1.3 are all good
CERTIFICATE_REMEDY = (
    "Give PEM files that belong together: the certificate with its chain, and its key without a passphrase."
)
STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)


@dataclass(frozen=True)
class Certificate:
    """PEM files of TLS: certificate with its chain, and its private key."""

    chain: Path
    key: Path


def bind_socket(host: str, port: int) -> socket.socket:
    """Return a listening socket at `host` and `port`; InputError if the address cannot be bound.

    It listens at once: two sockets that are only bound could share an address. Early requests wait in the backlog.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with ExitStack() as undo:
            listener = undo.enter_context(socket.socket(family, socket.SOCK_STREAM))
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((host, port))
            listener.listen(LISTEN_QUEUE)
            undo.pop_all()
    except OSError as error:
        raise InputError(
            f"{base_url(host, port)} cannot be served: {error.strerror or error}", _remedy(error, port)
        ) from error
    return listener


def base_url(host: str, port: int, is_tls: bool = False) -> str:
    """Return the URL of a page at a host name or an address; an IPv6 address stands in brackets (RFC 3986)."""
    return f"{'https' if is_tls else 'http'}://{f'[{host}]' if ':' in host else host}:{port}"


def require_protection(address: socket.socket, users: UserTable, certificate: Certificate | None) -> None:
    """Raise InputError for a socket beyond this computer without a user, or without a certificate for TLS."""
    host = str(address.getsockname()[0])
    if Client.at(host).is_local or (users.has_begun and certificate is not None):
        return
    missing = "there is no certificate for TLS" if users.has_begun else "no user exists yet"
    raise InputError(
        f"{host} is open to the network, and {missing}",
        "Create the first administrator with `diffuscope users add`, and give --certificate and --certificate-key. "
        "Or serve on 127.0.0.1, and reach it with `ssh -L 8000:127.0.0.1:8000 THIS-COMPUTER`.",
    )


def inherited_socket(environment: Mapping[str, str]) -> socket.socket | None:
    """Return the listening socket that systemd passed to this process (socket activation); None unless exactly one."""
    if environment.get("LISTEN_PID") != str(os.getpid()) or environment.get("LISTEN_FDS") != "1":
        return None
    return socket.socket(fileno=SD_LISTEN_FD)


def _remedy(error: OSError, port: int) -> str:
    """Return the remedy for a failed bind: a sentence for the user."""
    other = port + 1 if port < 65535 else 8000
    if error.errno == errno.EADDRINUSE:
        return f"Another program uses it, perhaps this one. Stop that, or choose another with --port {other}."
    if error.errno == errno.EACCES:
        return "Ports below 1024 belong to the system. Choose one with --port 8000."
    return "Give an address of this computer with --host: 127.0.0.1 for itself, 0.0.0.0 for the whole network."


def serve(
    spec: InstrumentSpec,
    address: socket.socket,
    data: Path,
    ready: Callable[[bool], None],
    watchdog: Watchdog,
    programme: Programme,
    measure: Measure,
    host_names: tuple[str, ...] = (),
    updater: tuple[Path | None, Path | None] = (None, None),
    uploader: Uploader | None = None,
    certificate: Certificate | None = None,
) -> None:
    """Open the store and the head, call `ready`, and serve at `address` until SIGTERM, SIGINT or a failure.

    The page is available while the exam still plans its FFTs; an error that stopped the server is raised at the end.
    `data`: data folder. `ready` takes whether the page asks for the set-up code of the first user. `host_names`:
    accepted host names beside the own ones. `measure`: the frontier measurement of this device. `updater`:
    the updater's state folder and its request folder. `uploader`: uploads to the receiver. `certificate`: of TLS, None
    for plain HTTP. Everything that was opened is closed at every exit. InputError for an address beyond this computer
    without users and TLS, SystemExit(0) for a signal before the server runs.
    """
    return_freed_arrays()
    clock = SystemClock()
    key = _audit_key(data)
    with _Stop() as stop, address, opened_store(data, clock, key) as store, ExitStack() as undo, _limited_logs(clock):
        require_protection(address, UserTable(data / FOLDER), certificate)
        data = store.folder  # of a read-only store: its copy in memory
        programme = _with_own_numbers(programme, store)
        dose_tables = DoseLedgerStore(store.engine, clock, light_limits().window_s)
        archive = Archive(archive_path(spec, data))
        event_log = undo.enter_context(closing(EventLog(data / "event-log")))
        context = AppContext(spec, archive, store, EventBus(), clock, watchdog, stop.failed)
        explorer = AccuracyExplorer(data / "accuracy", data / "plans", clock, spec, context.event_bus.publish, measure)

        exam = partial(_open_exam, context, dose_tables, data / "plans", explorer, programme)
        arbiter = HeadArbiter(context, exam, lambda: open_bench(spec, clock))
        undo.callback(arbiter.close)
        backups = undo.enter_context(closing(BackupRunner(data, lambda: arbiter.is_idle, clock)))
        routers = [
            accuracy_routes(explorer, store, lambda: arbiter.exam.head.calibration),
            update_routes(UpdateRequests(*updater, clock, version("diffuscope"))),
            event_log_routes(event_log, UsbDrives(), clock),
            backup_routes(backups, store, UsbDrives(), clock),
            erasure_routes(arbiter, backups),
        ]
        authenticator = Authenticator(data / FOLDER, clock, _has_demo(spec, address), store.refusal)
        app = create_app(
            arbiter,
            authenticator,
            programme,
            own_host_names() + host_names,
            technician_routers=routers,
            uploader=uploader,
            audit_log=_audit_log(store, key, clock),
        )
        _log_start(app.http.version, store)
        server = _limited_server(app.http, clock, context.event_bus, certificate)
        ready(not authenticator.users.has_begun and authenticator.user(None, OWN_SCREEN) is None)
        stop.register(server).run(sockets=[address])
    if (failure := arbiter.owner.failure) is not None or stop.has_failed:
        raise failure or DiffuscopeError("the instrument stopped unexpectedly")


def _audit_key(data: Path) -> bytes | None:
    """Return the key of a data folder, made at the first start; None, and a line in the log, if it cannot be read.

    StoreError for a folder of a version before the first release, in which nothing is written.
    """
    refuse_earlier_store(data / DATABASE)
    try:
        return load_or_create_audit_key(data)
    except (OSError, StoreDamaged) as error:
        log.error("no audit log is kept, and no file of a record is authenticated: %s", error)
        return None


def _audit_log(store: CaptureStore, key: bytes | None, clock: Clock) -> AuditLog | None:
    """Return the audit log of a store, None without a key or on a disk that takes no changes."""
    if store.refusal is not None or key is None:
        return None
    audit_log = AuditLog(store.folder, key, clock)
    try:
        audit_log.append("", "start", version=version("diffuscope"))
    except OSError as error:
        log.error("no audit log is kept: %s", error)
        return None
    return audit_log


def _has_demo(spec: InstrumentSpec, address: socket.socket) -> bool:
    """Return whether the demonstration user may exist: no real lamp or camera, and only this computer can connect."""
    is_played = {spec.light.backend, spec.camera.backend} <= {"sim", "replay"}
    return is_played and Client.at(str(address.getsockname()[0])).is_local


def _with_own_numbers(programme: Programme, store: CaptureStore) -> Programme:
    """Return the programme with the numbers of this device, whose identity is created at the first start.

    A disk that is read-only and has no identity leaves the programme as it is: it takes no pictures.
    """
    device = load_or_create_device(store.folder) if store.refusal is None else read_device(store.folder)
    return programme if device is None else programme.for_device(device.prefix)


def _limited_server(app: FastAPI, clock: Clock, event_bus: EventBus, certificate: Certificate | None) -> "Server":
    table = ConnectionTable(ConnectionLimits(), clock)
    tls = {} if certificate is None else {"ssl_certfile": certificate.chain, "ssl_keyfile": certificate.key}
    config = LimitedConfig(app, table, backlog=ACCEPTS, timeout_graceful_shutdown=1, ssl_ciphers=CIPHERS, **tls)
    try:
        config.load()
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        raise InputError(f"the certificate cannot be used: {error}", CERTIFICATE_REMEDY) from error
    return Server(config, event_bus)


def _log_start(version: str, store: CaptureStore) -> None:
    log.info("started, version %s", version)
    if moved := ", ".join(store.newly_quarantined):
        log.warning("interrupted captures of the last run are in quarantine/: %s", moved)


def _open_exam(
    context: AppContext, doses: DoseLedgerStore, plans: Path, explorer: AccuracyExplorer, programme: Programme
) -> ExamService:
    """Open the head with the calibration in force, and return its exam; `programme` has the slots of its captures."""
    pictures = VisitRepository(context.store.engine, programme, context.clock).pictures
    head = open_head(with_calibration(context.spec, context.archive.root), context.clock, doses)
    return ExamService(
        head,
        context.store,
        context.event_bus,
        context.clock,
        plans,
        context.on_failure,
        context.watchdog,
        lambda: explorer.budget_s,
        pictures.resumed_target,
    )


class _Stop:
    """Signal handling: stop the server on SIGTERM, SIGINT or a failed head, so that every `close` runs afterwards.

    uvicorn handles the signals too, but raises them again after its server has ended, and SIGTERM then kills the
    process before anything is closed. A signal before the server exists raises SystemExit(0) in the main thread; a
    signal during closing has no effect. The earlier handlers are restored at exit.
    """

    def __init__(self) -> None:
        self._failed = Event()
        self._server: uvicorn.Server | None = None

    def __enter__(self) -> Self:
        self._before = {number: signal.signal(number, self._stop) for number in STOP_SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    @property
    def has_failed(self) -> bool:
        """Whether `failed` was called."""
        return self._failed.is_set()

    def failed(self) -> None:
        """Stop the server because of a failure; `serve` then raises an error. Callable from any thread."""
        self._failed.set()
        if self._server is not None:
            self._server.should_exit = True

    def register(self, server: uvicorn.Server) -> uvicorn.Server:
        """Register the server that signals and failures stop, and return it."""
        self._server = server
        if self._failed.is_set():
            server.should_exit = True
        return server

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self._server is None:
            raise SystemExit(0)
        self._server.handle_exit(number, frame)


@contextmanager
def _limited_logs(clock: Clock) -> Iterator[None]:
    """Limit the rate of the records that clients can cause, in the loggers of asyncio and uvicorn."""
    limits = {logging.getLogger(name): LogRateLimit(clock) for name in LOGGER_NAMES}
    for logger, limit in limits.items():
        logger.addFilter(limit)
    try:
        yield
    finally:
        for logger, limit in limits.items():
            logger.removeFilter(limit)


class Server(uvicorn.Server):
    """uvicorn server that drops overdue connections, and closes its event streams before it waits for open ones."""

    def __init__(self, config: LimitedConfig, event_bus: EventBus) -> None:
        super().__init__(config)
        self._connections = config.connections
        self._event_bus = event_bus

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signal handling to `_Stop`."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to accept connections; asyncio sets the queue of the sockets to its number of accepts in a row."""
        is_tls = self.config.is_ssl
        listeners = [LimitedListener(server_socket, self._connections, is_tls) for server_socket in sockets or []]
        await super().startup(list[socket.socket](listeners))
        for listener in listeners:
            listener.listen(LISTEN_QUEUE)

    async def on_tick(self, counter: int) -> bool:
        """Drop the connections whose time-out is over, ten times per second; return whether the server ends."""
        self._connections.drop_overdue()
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close the event bus, which ends the event streams, then shut down."""
        self._event_bus.close()
        await super().shutdown(sockets)
