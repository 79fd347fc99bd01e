"""Work in a process of its own, at the lowest priority: whoever is in front of the camera comes first."""

import os
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

from device.errors import DiffuscopeError

SPAWNED = get_context("spawn")  # a forked child would hold the camera, the lamp and the database of its parent
LEAST_URGENT = 19

Say = Callable[[Any], None]


def apart(work: Callable[..., Any], *args: Any, say: Say) -> Any:
    """What `work(*args, say)` returns, or the error of ours that it raises; both must be able to travel (pickle).

    Raises DiffuscopeError if the process ends without a word.
    """
    here, there = SPAWNED.Pipe(duplex=False)
    process = SPAWNED.Process(target=_worked, args=(there, work, args), daemon=True)
    process.start()
    there.close()
    try:
        while True:
            kind, said = here.recv()
            if kind == "done":
                return said
            if kind == "failed":
                raise said
            say(said)
    except EOFError as error:
        raise DiffuscopeError("the computation ended without a result") from error
    finally:
        here.close()
        process.kill()
        process.join()


def _worked(there: Connection, work: Callable[..., Any], args: tuple[Any, ...]) -> None:
    os.nice(LEAST_URGENT)
    try:
        there.send(("done", work(*args, lambda said: there.send(("says", said)))))
    except DiffuscopeError as error:
        there.send(("failed", error))
