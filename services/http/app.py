"""App factory: every endpoint, middleware and background worker of one head arbiter."""

from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from fastapi import APIRouter, Depends, FastAPI
from fastapi.responses import JSONResponse

from services.delivery.removal import PictureRemoval
from services.delivery.upload_worker import UploadWorker, archive_builder
from services.delivery.uploader import Uploader
from services.delivery.usb_drives import UsbDrives
from services.health.alert_monitor import AlertMonitor, AlertSources
from services.http.access import AdmittedAnswers, access_required
from services.http.audit_trail import AuditTrail
from services.http.authentication import Authenticator
from services.http.client_limits import PREVIEW_LIMITS, STREAM_LIMITS, ClientLimits, limit_clients
from services.http.control_lease import ControlLease
from services.http.dependencies import acquire_control_lease, acquire_lease_for_light
from services.http.openapi import DocumentedApp
from services.http.problem_responses import problem_response, register_error_handlers
from services.http.rate_limits import RATES, Rate, RateLimits
from services.http.routes.audit import audit_router
from services.http.routes.calibration import calibration_router
from services.http.routes.captures import captures_router, press_router
from services.http.routes.clock import clock_router
from services.http.routes.events import event_router
from services.http.routes.exports import exports_router
from services.http.routes.login import login_router
from services.http.routes.montages import montage_router
from services.http.routes.preview import preview_router
from services.http.routes.removal import removal_routes
from services.http.routes.ssh_keys import ssh_keys_router
from services.http.routes.status import status_router
from services.http.routes.updates import UPLOAD_PATH
from services.http.routes.uploads import upload_router
from services.http.routes.users import users_router
from services.http.routes.visits import visits_router
from services.http.schemas.problems import ProblemResponse
from services.http.security import BodyLimit, CrossOriginProtection, HeadRequests, SecurityHeaders, own_host_names
from services.http.static_files import add_page_routes
from services.instrument.checkpointing import Checkpoints
from services.instrument.events import EventBus
from services.instrument.head_arbiter import HeadArbiter
from services.instrument.pending_captures import PendingCaptures
from services.instrument.status import read_status
from services.instrument.visit_montage import MontageMaker
from services.records.audit_log import AuditLog
from services.records.programme import Programme, load_programme
from services.records.upload_queue import UploadQueue
from services.records.visit_repository import VisitRepository


@dataclass(frozen=True)
class Application:
    """The HTTP application (`http`, an ASGI application) and the parts behind its endpoints.

    `upload_worker` is None if no receiver is set up.
    """

    http: FastAPI
    visits: VisitRepository
    lease: ControlLease
    alerts: AlertMonitor
    upload_worker: UploadWorker | None


def create_app(
    arbiter: HeadArbiter,
    authenticator: Authenticator,
    programme: Programme | None = None,
    host_names: tuple[str, ...] | None = None,
    usb_drives: UsbDrives | None = None,
    technician_routers: Sequence[APIRouter] = (),
    uploader: Uploader | None = None,
    stream_limits: ClientLimits = STREAM_LIMITS,
    preview_limits: ClientLimits = PREVIEW_LIMITS,
    audit_log: AuditLog | None = None,
    rates: Mapping[str, Rate] = RATES,
    system: Path = Path("/"),
) -> Application:
    """Return the HTTP application for one head arbiter, with every endpoint, middleware and background worker.

    `host_names` are the host names that the server accepts, beside localhost and the address of the connection; None:
    those of this computer. `programme` None loads the default programme. `technician_routers` are those of the
    technician's page. `uploader` uploads finished visits; None means that no receiver is set up.
    `stream_limits`, `preview_limits`: numbers of open event streams and of requests that wait for a live picture.
    `audit_log`: None keeps none. `rates`: limits of operations in time. `system`: root of the file system, from which
    the source of the clock and the keys of the card are read.
    """
    store = arbiter.context.store
    clock = arbiter.context.clock
    visits = VisitRepository(store.engine, programme or load_programme(), clock)
    lease = ControlLease(clock)
    queue = UploadQueue(store.engine, clock)
    pack = archive_builder(store, visits)
    worker = UploadWorker(queue, pack, uploader, lambda: arbiter.is_idle, clock) if uploader is not None else None
    alerts = _alert_monitor(arbiter, visits, lease, None if worker is None else queue, system)
    checkpoints = Checkpoints(store, lambda: arbiter.is_idle, lambda: arbiter.owner.state == "aim", clock)
    montages = MontageMaker(store, lambda: arbiter.is_idle, arbiter.context.spec.px_per_deg)
    life = _lifespan(arbiter.context.event_bus, alerts, checkpoints, worker, montages)
    app = _http_application(
        life, authenticator, own_host_names() if host_names is None else host_names, RateLimits(rates, clock)
    )
    app.add_middleware(AuditTrail, audit_log=audit_log, clock=clock, system=system)
    pending = PendingCaptures()
    controlled = [Depends(acquire_control_lease(lease))]
    lit = Depends(acquire_lease_for_light(lease))
    app.include_router(press_router(lambda: arbiter.exam, store, visits, pending), dependencies=[lit])
    app.include_router(captures_router(store, arbiter))
    app.include_router(visits_router(visits, lease, pending, checkpoints.request), dependencies=controlled)
    app.include_router(exports_router(visits, store, usb_drives or UsbDrives()), dependencies=controlled)
    app.include_router(montage_router(visits, montages))
    app.include_router(upload_router(worker), dependencies=controlled)
    app.include_router(status_router(arbiter, visits, lease, alerts, worker))
    app.include_router(preview_router(arbiter, visits), dependencies=[lit, Depends(limit_clients(preview_limits))])
    app.include_router(event_router(arbiter), dependencies=[Depends(limit_clients(stream_limits))])
    app.include_router(login_router(authenticator, lambda: arbiter.pressed_s))
    app.include_router(users_router(authenticator.users))
    app.include_router(ssh_keys_router(store, system, lambda: arbiter.pressed_s))
    app.include_router(audit_router(audit_log))
    app.include_router(clock_router(clock, system))
    app.include_router(calibration_router(arbiter, lit))
    for router in (*technician_routers, removal_routes(PictureRemoval(store, visits, clock))):
        app.include_router(router)
    add_page_routes(app)
    return Application(app, visits, lease, alerts, worker)


def _alert_monitor(
    arbiter: HeadArbiter, visits: VisitRepository, lease: ControlLease, queue: UploadQueue | None, system: Path
) -> AlertMonitor:
    """Return the monitor of the alerts of an application; `queue` None: nothing is uploaded."""
    context = arbiter.context
    sources = AlertSources(lambda: read_status(arbiter), context.store, visits, lambda: lease.holder, queue, system)
    return AlertMonitor(sources, context.clock, context.event_bus.publish)


Lifespan = Callable[[FastAPI], AbstractAsyncContextManager[None]]


def _http_application(
    lifespan: Lifespan, authenticator: Authenticator, host_names: tuple[str, ...], rates: RateLimits
) -> FastAPI:
    """Return a FastAPI application with access control, problem responses and middlewares, the last one outermost."""
    app = DocumentedApp(
        title="Diffuscope",
        version=version("diffuscope"),
        lifespan=lifespan,
        openapi_url=None,  # FastAPI would serve it past the dependencies
        docs_url=None,
        redoc_url=None,
        dependencies=[Depends(access_required(authenticator, rates))],
        responses={"4XX": {"model": ProblemResponse}, "5XX": {"model": ProblemResponse}},
    )
    register_error_handlers(app)

    @app.get("/api/openapi.json", include_in_schema=False)
    def openapi() -> JSONResponse:
        return JSONResponse(app.openapi())

    app.add_middleware(AdmittedAnswers, answer=problem_response)
    app.add_middleware(HeadRequests)
    app.add_middleware(CrossOriginProtection, names=host_names, answer=problem_response)
    app.add_middleware(BodyLimit, exempt=frozenset({UPLOAD_PATH}), answer=problem_response)
    app.add_middleware(SecurityHeaders)
    return app


def _lifespan(
    event_bus: EventBus,
    alerts: AlertMonitor,
    checkpoints: Checkpoints,
    upload_worker: UploadWorker | None,
    montages: MontageMaker,
) -> Lifespan:
    """Return the lifespan handler: alerts, checkpoints and upload worker start and stop with the server.

    At the end it also ends the montages and closes the event bus.
    """

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        alerts.begin()
        checkpoints.begin()
        if upload_worker is not None:
            upload_worker.begin()
        yield
        if upload_worker is not None:
            upload_worker.close()
        montages.close()
        checkpoints.close()
        alerts.close()
        event_bus.close()

    return life
