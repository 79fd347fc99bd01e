"""`diffuscope archive run`: compute what a plan still lacks, and write the table of all captures."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from device import atomic_io
from device.clock import Clock
from device.errors import DiffuscopeError, SettingError
from services.archive import cluster
from services.archive.content import different_versions, software
from services.archive.plan import Plan
from services.archive.result import TABLE, Quarantined, ResultFolder
from services.archive.solve import Outcome
from services.archive.table import write_table
from services.research.reconstruct_file import write_or_raise

PROGRESS_S = 2.0


@dataclass(frozen=True)
class Ran:
    """Numbers of captures after a run: with a result, in quarantine, left out; tasks run now, and their time in s."""

    done: int
    quarantined: int
    left_out: int
    computed: int
    seconds: float


def run_plan(
    plan: Plan,
    root: Path,
    clock: Clock,
    progress: Callable[[str], None],
    workers: int | None = None,
    scheduler: str | None = None,
) -> Ran:
    """Compute every capture without a result, except those in quarantine that cannot succeed; write the table.

    Idempotent. `workers` and `scheduler` as of `cluster.connected`. `progress` gets lines of text. SettingError for a
    folder into which another run writes, and for a plan of other versions; StoreFull or StoreError if the disk
    refuses; DiffuscopeError if the scheduler or a source is gone: results so far stay.
    """
    if found := different_versions(plan.software, software()):
        raise SettingError(
            f"the plan was made with other versions than those of this machine: {found}", "Make a new plan."
        )
    root = root.absolute()  # workers have other working directories
    results = ResultFolder(root)
    write_or_raise(root, lambda: atomic_io.make_folder(root, None))
    try:
        with atomic_io.file_lock(results.lock, wait=False, private=False):
            results.prepare(plan)
            return _run(plan, results, clock, progress, workers, scheduler)
    except BlockingIOError as error:
        raise SettingError(f"another run is writing into {root}", "Wait for its end, or choose another.") from error


def _run(
    plan: Plan,
    results: ResultFolder,
    clock: Clock,
    progress: Callable[[str], None],
    workers: int | None,
    scheduler: str | None,
) -> Ran:
    kept = {failure.name for failure in results.quarantined() if not failure.retry}
    captures = sorted(plan.captures, key=lambda capture: capture.calibration)
    names = [capture.result for capture in captures if capture.result not in kept and not results.has(capture.result)]
    begin_s = clock.now_s()
    if names:
        with cluster.connected(workers, scheduler) as client:
            cluster.refuse_other_versions(client)
            used = {capture.calibration for capture in captures}
            for calibration in plan.calibrations:
                if calibration.digest in used:
                    cluster.send_calibration(client, calibration)
            progress(f"{len(names)} of {len(captures)} captures to compute; dashboard: {client.dashboard_link}")
            computing = _Computing(plan, results, len(names), clock, progress)
            for outcome in cluster.outcomes(client, plan, names, results.root):
                computing.take(outcome)
            computing.require_results()
    done = sum(results.has(capture.result) for capture in captures)
    path = results.root / TABLE
    write_or_raise(path, lambda: write_table(plan, results))
    return Ran(done, len(captures) - done, len(plan.left_out), len(names), clock.now_s() - begin_s)


class _Computing:
    """Progress of a run, and its quarantine."""

    def __init__(
        self, plan: Plan, results: ResultFolder, count: int, clock: Clock, progress: Callable[[str], None]
    ) -> None:
        self._planned = {capture.result: capture for capture in plan.captures}
        self._results, self._count, self._clock, self._progress = results, count, clock, progress
        self._begin_s = self._shown_s = clock.now_s()
        self._ended = self._failed = 0
        self._stored: list[str] = []

    def take(self, outcome: Outcome) -> None:
        """Record the end of a task; DiffuscopeError if its whole source is gone."""
        failure = outcome.failure
        if failure is None:
            self._stored.append(outcome.name)
            self._results.release(outcome.name)
        else:
            self._quarantine(failure)
        self._ended += 1
        now_s = self._clock.now_s()
        if now_s - self._shown_s >= PROGRESS_S or self._ended == self._count:
            self._shown_s = now_s
            each_s = (now_s - self._begin_s) / self._ended
            self._progress(
                f"{self._ended}/{self._count} done, {self._failed} in quarantine, {60 / max(each_s, 1e-9):.0f} "
                f"captures/min, {each_s * (self._count - self._ended):.0f} s left"
            )

    def require_results(self) -> None:
        """Raise DiffuscopeError if workers have stored results and none of them is here."""
        if self._stored and not any(map(self._results.has, self._stored)):
            raise DiffuscopeError(
                f"the workers stored {len(self._stored)} results, but none is in {self._results.root}",
                "Give a folder that has this path on every machine, on a disk that all of them share.",
            )

    def _quarantine(self, failure: Quarantined) -> None:
        capture = self._planned[failure.name]
        source = Path(capture.source)
        if failure.code == "source" and not source.is_dir():
            raise DiffuscopeError(f"{source} is gone", f"Connect it again. {cluster.RESUME}")
        self._failed += 1
        write_or_raise(self._results.root, lambda: self._results.quarantine(replace(failure, id=capture.id)))
