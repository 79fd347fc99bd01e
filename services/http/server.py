"""Server process: bind the socket, open store and head, and run uvicorn until a signal or a failure.

The socket is bound first, so that a port in use is an error before any file or device is opened.
"""

import asyncio
import errno
import logging
import os
import signal
import socket
import ssl
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from threading import Event
from types import FrameType
from typing import Any, Self

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
from services.http.pairing import pairing_app
from services.http.routes.accuracy import accuracy_routes
from services.http.routes.backup import backup_routes
from services.http.routes.erasure import erasure_routes
from services.http.routes.event_log import event_log_routes
from services.http.routes.updates import update_routes
from services.http.security import own_host_names
from services.identity.audit_key import load_or_create_audit_key
from services.identity.certificates import check_validity, host_names
from services.identity.renewal import AUTHORITY, SERVER
from services.identity.users import FOLDER
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
PAGE_SOCKET, NETWORK_SOCKET, PAIRING_SOCKET = (f"diffuscope{name}.socket" for name in ("", "-network", "-pairing"))
RELOAD_TICKS = 10  # of 0.1 s, between two looks at the files of the certificate
CIPHERS = "ECDHE+AESGCM:ECDHE+CHACHA20"  # of TLS 1.2; those of 1.3 are all good
REMEDY = "Make one with `diffuscope label`, or serve on 127.0.0.1, with `ssh -L 8000:127.0.0.1:8000 THIS-COMPUTER`."
STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)


@dataclass(frozen=True)
class Listener:
    """Listening socket of the page, by TLS with a `certificate` (PEM, with its key); or of the pairing page."""

    socket: socket.socket
    certificate: Path | None = None
    is_pairing: bool = False

    @property
    def is_local(self) -> bool:
        """Whether only this computer can connect."""
        return Client.at(str(self.socket.getsockname()[0])).is_local

    @property
    def host_names(self) -> list[str]:
        """Host names of the certificate."""
        return [] if self.certificate is None else host_names(self.certificate.read_bytes())


def open_listeners(
    environment: Mapping[str, str], host: str, port: int, tls: Path, pairing_port: int
) -> list[Listener]:
    """Return the listeners of the sockets of systemd, or of `host`: `port`, and `pairing_port` unless that is 0.

    Beyond this computer the page is served with the certificate in the folder `tls` (services/identity/renewal.py).
    InputError for an address that cannot be bound, and beyond this computer without a valid certificate.
    """
    sockets, file, listeners = inherited_sockets(environment), tls / SERVER, list[Listener]()
    with ExitStack() as undo:
        if PAGE_SOCKET not in sockets:
            ports = {PAGE_SOCKET: port} | ({PAIRING_SOCKET: pairing_port} if pairing_port else {})
            sockets = {name: undo.enter_context(bind_socket(host, number)) for name, number in ports.items()}
        elif not file.exists():  # the page of this computer is served all the same
            sockets = {PAGE_SOCKET: sockets[PAGE_SOCKET]}
        for name in (PAGE_SOCKET, NETWORK_SOCKET, PAIRING_SOCKET):  # systemd passes them in any order
            if name not in sockets:
                continue
            listener = Listener(sockets[name], is_pairing=name == PAIRING_SOCKET)
            if not listener.is_local and not listener.is_pairing:
                listener = Listener(sockets[name], file)
                _check_certificate(file)
            if not listener.is_pairing or (tls / AUTHORITY).exists():
                listeners.append(listener)
        undo.pop_all()
    return listeners


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


def inherited_sockets(environment: Mapping[str, str]) -> dict[str, socket.socket]:
    """Return the listening sockets that systemd passed to this process (socket activation), by the names of units."""
    if environment.get("LISTEN_PID") != str(os.getpid()):
        return {}
    names = environment.get("LISTEN_FDNAMES", PAGE_SOCKET).split(":")
    numbers = range(SD_LISTEN_FD, SD_LISTEN_FD + int(environment.get("LISTEN_FDS", 0)))
    return {name: socket.socket(fileno=number) for name, number in zip(names, numbers, strict=False)}


def _check_certificate(file: Path) -> None:
    try:
        check_validity(file, file, SystemClock())
    except ValueError as error:
        raise InputError(f"the network is served by TLS, and the certificate {file} {error}", REMEDY) from error


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
    listeners: Sequence[Listener],
    data: Path,
    tls: Path,
    ready: Callable[[bool], None],
    watchdog: Watchdog,
    programme: Programme,
    measure: Measure,
    host_names: tuple[str, ...] = (),
    updater: tuple[Path | None, Path | None] = (None, None),
    uploader: Uploader | None = None,
) -> None:
    """Open the store and the head, call `ready`, and serve at `listeners` until SIGTERM, SIGINT or a failure.

    The page is available while the exam still plans its FFTs; an error that stopped the server is raised at the end.
    `data`: data folder. `tls`: folder of the certificate and the set-up code. `ready` takes whether the page asks for
    that code. `host_names`: accepted host names beside the own ones. `measure`: the frontier measurement of this
    device. `updater`: the updater's state folder and its request folder. `uploader`: uploads to the receiver.
    Everything that was opened is closed at every exit. SystemExit(0) for a signal before the server runs.
    """
    return_freed_arrays()
    clock = SystemClock()
    key = _audit_key(data)
    with _Stop() as stop, ExitStack() as undo, opened_store(data, clock, key) as store, _limited_logs(clock):
        for listener in listeners:
            undo.enter_context(listener.socket)
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
        authenticator = Authenticator(data / FOLDER, clock, _has_demo(spec, listeners), store.refusal, tls)
        app = create_app(
            arbiter,
            authenticator,
            programme,
            own_host_names() + host_names + tuple(name for listener in listeners for name in listener.host_names),
            technician_routers=[
                accuracy_routes(explorer, store, lambda: arbiter.exam.head.calibration),
                update_routes(UpdateRequests(*updater, clock, version("diffuscope"))),
                event_log_routes(event_log, UsbDrives(), clock),
                backup_routes(backups, store, UsbDrives(), clock),
                erasure_routes(arbiter, backups),
            ],
            uploader=uploader,
            audit_log=_audit_log(store, key, clock),
        )
        _log_start(app.http.version, store)
        servers = _limited_servers(app.http, tls, clock, context.event_bus, listeners)
        ready(not authenticator.users.has_begun and authenticator.user(None, OWN_SCREEN) is None)
        stop.register(servers[0])
        asyncio.run(_serve_together(servers, listeners))
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


def _has_demo(spec: InstrumentSpec, listeners: Sequence[Listener]) -> bool:
    """Return whether the demonstration user may exist: no real lamp or camera, and only this computer can connect."""
    is_played = {spec.light.backend, spec.camera.backend} <= {"sim", "replay"}
    return is_played and all(listener.is_local for listener in listeners)


def _with_own_numbers(programme: Programme, store: CaptureStore) -> Programme:
    """Return the programme with the numbers of this device, whose identity is created at the first start.

    A disk that is read-only and has no identity leaves the programme as it is: it takes no pictures.
    """
    device = load_or_create_device(store.folder) if store.refusal is None else read_device(store.folder)
    return programme if device is None else programme.for_device(device.prefix)


def _limited_servers(
    page: FastAPI, tls: Path, clock: Clock, event_bus: EventBus, listeners: Sequence[Listener]
) -> list["Server"]:
    """Return a server for each listener; they share the limits of connections, and the first one runs the lifespan."""
    table, servers = ConnectionTable(ConnectionLimits(), clock), list[Server]()
    secure_port = next((one.socket.getsockname()[1] for one in listeners if one.certificate is not None), 443)
    for listener in listeners:
        app = pairing_app(tls, secure_port) if listener.is_pairing else page
        options: dict[str, Any] = {"lifespan": "off" if servers else "auto", "ssl_certfile": listener.certificate}
        config = LimitedConfig(app, table, backlog=ACCEPTS, timeout_graceful_shutdown=1, ssl_ciphers=CIPHERS, **options)
        servers.append(Server(config, event_bus))
    return servers


async def _serve_together(servers: Sequence["Server"], listeners: Sequence[Listener]) -> None:
    """Run all servers until the first one has ended."""
    first, *others = [server.serve([own.socket]) for server, own in zip(servers, listeners, strict=True)]
    tasks = [asyncio.create_task(other) for other in others]
    await first
    for server in servers:
        server.should_exit = True
    await asyncio.gather(*tasks)


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
        self._written_ns = 0

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
        if self.config.ssl is not None and counter % RELOAD_TICKS == 0:
            self._reload_certificate(self.config.ssl, Path(str(self.config.ssl_certfile)))
        return await super().on_tick(counter)

    def _reload_certificate(self, context: ssl.SSLContext, file: Path) -> None:
        """Serve further connections with a certificate that replaced the one in use; open ones keep theirs."""
        written_ns = file.stat().st_mtime_ns if file.exists() else self._written_ns
        if written_ns == self._written_ns:
            return
        self._written_ns = written_ns
        try:
            for used in (ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), context):  # a damaged file reaches the first one only
                used.load_cert_chain(file)
        except OSError as error:
            log.error("the certificate was replaced and cannot be used: %s", error)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close the event bus, which ends the event streams, then shut down."""
        self._event_bus.close()
        await super().shutdown(sockets)
