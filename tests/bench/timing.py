"""Interleaved timing of functions, and a table of figures with limits and verdicts."""

import time
import tracemalloc
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

ROUNDS = 15


def turns_ms(*acts: Callable[[], object], rounds: int = ROUNDS) -> NDArray[np.float64]:
    """Return the times of interleaved calls, (rounds, acts), after two warm-up rounds.

    Each function is called twice and the second call counts: the caches of the first call are filled by other code,
    which would charge the shortest function most.
    """
    times = np.empty((rounds + 2, len(acts)))
    for turn in times:
        for k, act in enumerate(acts):
            act()
            begin = time.perf_counter()
            act()
            turn[k] = time.perf_counter() - begin
    return times[2:] * 1e3


def side_by_side_ms(*acts: Callable[[], object], rounds: int = ROUNDS) -> list[float]:
    """Return the median time of each of several interleaved functions."""
    return [float(ms) for ms in np.median(turns_ms(*acts, rounds=rounds), axis=0)]


def against_the_first(*acts: Callable[[], object], rounds: int = 31) -> tuple[list[float], list[float]]:
    """Return median times, and the median over rounds of each function's ratio to the first.

    A burst of other load lasts longer than a round: it slows both sides of a ratio and leaves the ratio unchanged.
    """
    times = turns_ms(*acts, rounds=rounds)
    return [float(v) for v in np.median(times, axis=0)], [float(v) for v in np.median(times / times[:, :1], axis=0)]


def peak_mb(act: Callable[[], object]) -> float:
    """Return the peak memory of Python's allocators (numpy arrays included) during a call, above that before it."""
    tracemalloc.start()
    act()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 2**20


def head(title: str, *columns: str) -> None:
    """Print the first line of a table."""
    print(f"\n{title:<52}" + "".join(f"{column:>9}" for column in columns), flush=True)


def row(name: str, *cells: float | str | None, limit: float | None = None, value: float | None = None) -> None:
    """Print one line: figures, then, for a `value` with a limit, the limit and whether it is kept."""
    words = "".join(f"{_cell(cell):>9}" for cell in cells)
    verdict = "" if limit is None or value is None else f"{limit:9.2f}   {'ok' if value <= limit else 'OVER'}"
    print(f"{name:<52}{words}{verdict}", flush=True)


def _cell(cell: float | str | None) -> str:
    match cell:
        case None:
            return "-"
        case str():
            return cell
        case _:
            return f"{cell:.3f}" if abs(cell) < 1 else f"{cell:.2f}" if abs(cell) < 100 else f"{cell:.0f}"
