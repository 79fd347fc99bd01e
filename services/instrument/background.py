"""Blocking work in the background: in a thread of this process, or in a subprocess at the lowest priority."""

import os
import signal
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from device.errors import DiffuscopeError

POLL_S = 0.05  # poll interval, imperceptible to users
SPAWNED = get_context("spawn")  # a forked child would inherit camera, lamp and database of its parent
LOWEST_PRIORITY = 19

Result = TypeVar("Result")
Report = Callable[[Any], None]


def run_in_thread(work: Callable[[], Result], keep_alive: Callable[[], None]) -> Result:
    """Run `work` in a thread and return its result or raise its error; call `keep_alive` every POLL_S meanwhile."""
    with ThreadPoolExecutor(1, "aside") as executor:
        result = executor.submit(work)
        while wait([result], POLL_S).not_done:
            keep_alive()
    return result.result()


def run_in_subprocess(
    work: Callable[..., Any], *args: Any, report: Report, may_run: Callable[[], bool] = lambda: True
) -> Any:
    """Run `work(*args, send)` in a subprocess of lowest priority and return its result; values must be picklable.

    Each message that `work` passes to `send` is passed to `report` in this process. While `may_run`, called every
    POLL_S, returns false, the subprocess is stopped; an error that it raises ends the subprocess. Raises the
    DiffuscopeError of `work`, or DiffuscopeError if the process ends without a result.
    """
    receiver, sender = SPAWNED.Pipe(duplex=False)
    process = SPAWNED.Process(target=_run_worker, args=(sender, work, args), daemon=True)
    process.start()
    sender.close()
    is_stopped = False
    try:
        while True:
            if is_stopped == may_run():
                is_stopped = not is_stopped
                os.kill(process.pid or 0, signal.SIGSTOP if is_stopped else signal.SIGCONT)
            if not receiver.poll(POLL_S):
                continue
            kind, value = receiver.recv()
            if kind == "done":
                return value
            if kind == "failed":
                raise value
            report(value)
    except EOFError as error:
        raise DiffuscopeError("the computation ended without a result") from error
    finally:
        receiver.close()
        process.kill()
        process.join()


def _run_worker(sender: Connection, work: Callable[..., Any], args: tuple[Any, ...]) -> None:
    os.nice(LOWEST_PRIORITY)
    try:
        sender.send(("done", work(*args, lambda message: sender.send(("says", message)))))
    except DiffuscopeError as error:
        sender.send(("failed", error))
