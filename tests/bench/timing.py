"""Acts that take turns, and a table of figures with their limits and a verdict."""

import statistics
import time
from collections.abc import Callable

ROUNDS = 15


def side_by_side_ms(*acts: Callable[[], object], rounds: int = ROUNDS) -> list[float]:
    """Median times of several acts that take turns, after two turns that warm up.

    A neighbour's burst then hits all of them alike, and the ratio of two medians is about the code.
    """
    times: list[list[float]] = [[] for _ in acts]
    for k in range(rounds + 2):
        for act, own in zip(acts, times, strict=True):
            begin = time.perf_counter()
            act()
            if k >= 2:
                own.append(time.perf_counter() - begin)
    return [statistics.median(own) * 1e3 for own in times]


def head(title: str, *columns: str) -> None:
    """The first line of a table."""
    print(f"\n{title:<52}" + "".join(f"{column:>9}" for column in columns), flush=True)


def row(name: str, *cells: float | str | None, limit: float | None = None, value: float | None = None) -> None:
    """One line: figures, then, where `value` has a limit, the limit and whether it is kept."""
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
