"""Dask side of a run: connection, versions, calibrations on the workers, and a bounded number of tasks under way.

A task is a value of `solve.Task`; its function is imported by name on the worker. Nothing that comes from an archive is
unpickled or executed.
"""

import hashlib
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import dask
from distributed import Client, LocalCluster, Worker, WorkerPlugin, as_completed, get_worker
from distributed.client import ClosedClientError, FutureCancelledError
from distributed.comm.core import CommClosedError
from distributed.scheduler import KilledWorker

from device import atomic_io
from device.errors import DiffuscopeError, SettingError, StoreError, StoreFull
from services.archive.content import different_versions, software
from services.archive.plan import Plan, PlannedCalibration
from services.archive.result import Quarantined, ResultFolder
from services.archive.solve import CalibrationFiles, Outcome, Solvers, Task, local_names

log = logging.getLogger(__name__)

TASKS_PER_THREAD = 4  # under way: enough that no worker waits for the next one, few enough that memory stays flat
ALLOWED_FAILURES = 5  # workers that may end during one task before the capture is put into quarantine
CONNECT_TIMEOUT_S = 20.0
TRIES = 3
RESUME = "Run the same command again: it resumes."
LOST = (CommClosedError, ClosedClientError, FutureCancelledError, TimeoutError)
_LOCK = Lock()  # a worker with several threads: the solvers are for one thread at a time

dask.config.set(
    {
        "distributed.scheduler.allowed-failures": ALLOWED_FAILURES,
        "distributed.scheduler.worker-ttl": "5 minutes",
        "distributed.admin.system-monitor.gil.enabled": False,
        "distributed.worker.profile.enabled": False,
        # Without Dask's MALLOC_TRIM_THRESHOLD_=65536: it unmaps every large array at its end, which doubled the time of
        # a capture (0.23 to 0.44 s, 270 x 480 pixels) by page faults.
        "distributed.nanny.pre-spawn-environ": {"OMP_NUM_THREADS": 1, "MKL_NUM_THREADS": 1, "OPENBLAS_NUM_THREADS": 1},
    }
)


@contextmanager
def connected(workers: int | None, scheduler: str | None) -> Iterator[Client]:
    """Yield a client of a cluster: of the scheduler at this address, or of worker processes on this machine.

    `workers`: number of processes of one thread; None: one for each processor. SettingError for a scheduler that does
    not answer, DiffuscopeError if the worker processes end while they start.
    """
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            remedy = "Start it with `dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`."
            raise SettingError(f"no scheduler answers at {scheduler}: {error}", remedy) from error
        with client:
            yield client
        return
    with _local_cluster(workers or os.cpu_count() or 1) as cluster, Client(cluster, set_as_default=False) as client:
        yield client


def _local_cluster(workers: int) -> LocalCluster:
    """Start worker processes on this machine; again if one of them is killed meanwhile."""
    for _ in range(TRIES):
        try:
            return LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=":0")
        except RuntimeError as error:
            log.warning("worker processes ended while they started: %s", error)
    raise DiffuscopeError("worker processes end while they start", "Give the machine more memory, or fewer --workers.")


def _retried(call: Callable[[], Any]) -> Any:
    """Return what an idempotent call of the cluster returns; a worker may end meanwhile, and another takes its place.

    DiffuscopeError after TRIES failures.
    """
    for _ in range(TRIES - 1):
        try:
            return call()
        except OSError as error:
            log.warning("calling the workers again: %s", error)
    try:
        return call()
    except OSError as error:
        raise DiffuscopeError(f"the workers do not answer: {error}", RESUME) from error


def refuse_other_versions(client: Client) -> None:
    """Raise SettingError unless scheduler and all workers have the client's versions of Dask, Python and the solver."""
    remedy = "Install the same release of Diffuscope and its extra `archive` on every machine."
    try:
        _retried(lambda: client.get_versions(check=True))
        there = _retried(lambda: client.run(software))
    except ValueError as error:
        raise SettingError(f"client and cluster have different versions: {error}", remedy) from error
    except ModuleNotFoundError as error:
        raise SettingError(f"a worker has no {error.name}", remedy) from error
    for worker, found in there.items():
        if differing := different_versions(software(), found):
            raise SettingError(f"the worker {worker} has other versions: {differing}", remedy)


class CalibrationPlugin(WorkerPlugin):
    """Files of one calibration, which the scheduler sends once to each worker, also to one that starts later."""

    def __init__(self, digest: str, files: dict[str, bytes]) -> None:
        self.name = f"diffuscope-{digest}"
        self._digest, self._files = digest, files

    def setup(self, worker: Worker) -> None:
        """Write the files into the local folder of the worker."""
        _local_calibrations(worker).add(self._digest, self._files)


def send_calibration(client: Client, calibration: PlannedCalibration) -> None:
    """Send the files of a calibration to all workers; SettingError if they changed since the plan."""
    files = {}
    for (_, name), file in zip(local_names(calibration), calibration.files, strict=True):
        files[name] = _planned_content(Path(file.path), file.sha256)
    _retried(lambda: client.register_plugin(CalibrationPlugin(calibration.digest, files)))


def _planned_content(path: Path, sha256: str) -> bytes:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SettingError(f"{path} cannot be read: {error.strerror}", "Give the source again.") from error
    if hashlib.sha256(content).hexdigest() != sha256:
        raise SettingError(f"{path} changed since the plan was made", "Make a new plan.")
    return content


def _local_calibrations(worker: Worker) -> CalibrationFiles:
    return CalibrationFiles(Path(worker.local_directory) / "calibrations")


@lru_cache(maxsize=1)
def _solvers(local_folder: str) -> Solvers:
    """Return the planned solvers of this worker process."""
    return Solvers(CalibrationFiles(Path(local_folder) / "calibrations"))


def solve_on_worker(task: Task, root: str) -> Outcome:
    """Compute one task on a Dask worker and store its result below `root`."""
    worker = get_worker()
    with _LOCK:
        return _solvers(str(worker.local_directory)).solve(task, ResultFolder(Path(root)), str(worker.address))


def outcomes(client: Client, plan: Plan, names: Sequence[str], root: Path) -> Iterator[Outcome]:
    """Yield the end of each named task; a bounded number of them is under way.

    StoreFull or StoreError if results cannot be written, DiffuscopeError if the scheduler is lost.
    """
    calibrations = {calibration.digest: calibration for calibration in plan.calibrations}
    captures = {capture.result: capture for capture in plan.captures}
    waiting = iter(names)

    def submit() -> Any | None:
        name = next(waiting, None)
        if name is None:
            return None
        capture = captures[name]
        task = Task(capture, calibrations[capture.calibration], plan.settings, plan.software)
        return client.submit(solve_on_worker, task, str(root), key=f"capture-{name}", retries=1, pure=False)

    most = TASKS_PER_THREAD * max(1, sum(client.nthreads().values()))
    first = [future for _ in range(most) if (future := submit()) is not None]
    under_way = as_completed(first, loop=client.loop)
    try:
        for future in under_way:
            yield _outcome(future)
            if (following := submit()) is not None:
                under_way.add(following)
    except LOST as error:
        raise DiffuscopeError(f"the scheduler no longer answers: {error}", RESUME) from error


def _outcome(future: Any) -> Outcome:
    """Return the end of a task; a worker that ended too often, or an unknown error, is a failure of the capture."""
    name = str(future.key).removeprefix("capture-")
    if future.status == "finished":
        outcome: Outcome = future.result()
        return outcome
    if future.status != "error":
        raise DiffuscopeError(f"the scheduler lost a task ({future.status})", RESUME)
    error = future.exception()
    if isinstance(error, OSError):
        full = StoreFull if atomic_io.is_full(error) else StoreError
        raise full(f"a result cannot be written: {error.strerror or error}", f"Make room. {RESUME}") from error
    if isinstance(error, KilledWorker):
        reason = f"{ALLOWED_FAILURES + 1} workers ended while they computed it"
        return Outcome(name, 0.0, Quarantined(name, "killed", reason, "Give the workers more memory.", retry=True))
    return Outcome(name, 0.0, Quarantined(name, "error", f"{type(error).__name__}: {error}", retry=True))
