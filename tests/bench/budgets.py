"""`make bench-budget`: presses of the real server with the simulated head, for each choice of the time budget.

Columns: 50th and 99th percentile of the time from the last read-out to the picture, of that from the tap to the
picture, and of that from the request to its answer (stored), in s; the p99 share of the budget; presses that missed
their deadline (5 % over it); fewest rounds; pictures in colour; median processor time of a press in s. Exit status 1 if
a press of a choice missed its deadline or has no round.
"""

import argparse
import json
import os
import sys
import tempfile
import time
import urllib.request
from dataclasses import dataclass
from http.cookiejar import CookieJar
from pathlib import Path
from typing import Any

import numpy as np

from services.health.thresholds import MAX_OVERRUN, misses_deadline
from services.instrument.time_budget import PACES_S
from tests.bench import timing
from tests.bench.attacks import ROOT, Instrument

TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Pressed:
    """One press: its report, whether there is a picture in colour, seconds to the answer and of the processor."""

    report: dict[str, Any]
    in_colour: bool
    answer_s: float
    processor_s: float


class Technician:
    """Client of the demonstration user, who is a technician too."""

    def __init__(self, port: int) -> None:
        self._url = f"http://127.0.0.1:{port}/api/"
        self._opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(CookieJar()))

    def ask(self, method: str, path: str, body: Any) -> Any:
        """Send one request and return its answer."""
        headers = {"Content-Type": "application/json"}
        request = urllib.request.Request(self._url + path, json.dumps(body).encode(), headers, method=method)
        with self._opener.open(request, timeout=120) as answer:
            return json.loads(answer.read())


def main() -> int:
    """Press for each choice, one press after the other, and print its figures; return 1 if a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--presses", type=int, default=60, help="presses of each choice")
    parser.add_argument("--only", action="append", choices=list(PACES_S), help="just this choice; may be repeated")
    words = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        instrument = Instrument(ROOT, Path(folder) / "data")
        with instrument.running() as process:
            technician = Technician(instrument.port)
            print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the begin")
            columns = ("read-out", "p99", "tap", "p99", "answer", "p99", "share", "missed", "rounds", "colour", "cpu")
            timing.head(f"{words.presses} presses of each choice", *columns, "limit")
            is_kept = []
            for pace in words.only or PACES_S:
                technician.ask("PUT", "technician/pace", {"pace": pace})
                press(technician, process.pid, 0)  # the first one of a choice finds its memory
                is_kept.append(judged(pace, [press(technician, process.pid, k) for k in range(words.presses)]))
            print(f"load {os.getloadavg()[0]:.1f} at the end")
    return 0 if all(is_kept) else 1


def press(technician: Technician, process: int, k: int) -> Pressed:
    """Take the picture number `k`, of the right and of the left eye in turn."""
    before_s, begin_s = processor_s(process), time.perf_counter()
    capture = technician.ask("POST", "captures", {"eye": ("OD", "OS")[k % 2]})
    answer_s = time.perf_counter() - begin_s
    return Pressed(capture["report"], "colour" in capture["links"], answer_s, processor_s(process) - before_s)


def judged(pace: str, pressed: list[Pressed]) -> bool:
    """Print the figures of a choice; return whether every picture was in time and has a round."""
    reports = [one.report for one in pressed]
    read_out_s = [report["from_read_out_s"] for report in reports]
    times = (read_out_s, [report["from_tap_s"] for report in reports], [one.answer_s for one in pressed])
    missed = sum(misses_deadline(report["from_read_out_s"], report["budget_s"]) for report in reports)
    rounds = min(report["rounds"] for report in reports)
    share = float(np.percentile(read_out_s, 99)) / PACES_S[pace]
    row = [float(figure) for seconds in times for figure in np.percentile(seconds, (50, 99))]
    counts = (f"{missed}", f"{rounds}", f"{sum(one.in_colour for one in pressed)}")
    spent_s = float(np.median([one.processor_s for one in pressed]))
    worst = max(read_out_s) / PACES_S[pace] if rounds else 2.0
    timing.row(f"{pace}, {PACES_S[pace]:g} s", *row, share, *counts, spent_s, limit=1 + MAX_OVERRUN, value=worst)
    return missed == 0 and rounds > 0


def processor_s(process: int) -> float:
    """Return the processor time of a process until now, user and system."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


if __name__ == "__main__":
    sys.exit(main())
