"""`make bench-store`: kills, stops and damage of a running instrument's store, and the time from start to a press.

The real program runs with the small simulated head. After each end the store is opened again by the next start, and
every acknowledged capture must be listed. `--kills` sets the number of ends, SIGKILL and SIGTERM by turns.
"""

import argparse
import random
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPException
from pathlib import Path

import numpy as np

from device.clock import SystemClock
from services.records.capture import Capture, CaptureReport, StoredVerdict
from services.records.capture_store import CaptureStore
from services.records.quarantine import REQUIRED_FILES
from tests.bench import timing
from tests.journey.conftest import SMALL_HEAD
from tests.journey.test_cli_server import Server
from tests.store_damage import DAMAGES, plan, targets

DAMAGED_STARTS = 40
CAPTURES = (100, 1_000, 5_000)
LIMIT_S = 5.0


def main() -> None:
    """Run the three measurements and print them."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--kills", type=int, default=200)
    words.add_argument("--damaged", type=int, default=DAMAGED_STARTS)
    chosen = words.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        head = Path(folder) / "head.toml"
        head.write_text(SMALL_HEAD)
        data = kill_and_start(Path(folder), head, chosen.kills)
        start_damaged(data, head, chosen.damaged)
        measure_openings(Path(folder))


def kill_and_start(folder: Path, head: Path, kills: int) -> Path:
    """End the instrument at random times of presses, start it again, and count what was lost; return its data."""
    data, draw, acknowledged = folder / "data", random.Random(20), set[str]()
    server, keys = Server(head, data, {}), (f"{number:016x}" for number in range(1, 1 << 20))
    starts_s, lost, logs_left = list[tuple[float, float]](), 0, 0
    for turn in range(kills):
        end = signal.SIGTERM if turn % 2 else signal.SIGKILL
        begin = time.perf_counter()
        with server.running() as process, ThreadPoolExecutor(1) as pool:
            answered = time.perf_counter() - begin
            while server.ask("GET", "/api/status")["state"] != "aim":
                time.sleep(0.02)
            starts_s.append((answered, time.perf_counter() - begin))
            lost += len(acknowledged - set(_every(server)))
            presses = pool.submit(_press_until_killed, server, keys, acknowledged)
            time.sleep(draw.uniform(0.05, 2.0))
            process.send_signal(end)
            process.wait(60)
            presses.result()
        logs_left += end == signal.SIGTERM and data.joinpath("store.sqlite-wal").exists()
    with server.running():
        lost += len(acknowledged - set(_every(server)))
    timing.head("ends of the instrument", "ends", "stored", "lost", "log left")
    timing.row("SIGKILL and SIGTERM by turns", str(kills), str(len(acknowledged)), str(lost), str(logs_left))
    first, aim = np.median(np.array(starts_s), axis=0)
    timing.head("from start", "answer s", "press s", "limit")
    timing.row("median", first, aim, limit=LIMIT_S, value=aim)
    return data


def _press_until_killed(server: Server, keys: Iterator[str], acknowledged: set[str]) -> None:
    for number, key in enumerate(keys):
        try:
            acknowledged.add(server.ask("POST", "/api/captures", {"eye": ("OD", "OS")[number % 2], "key": key})["id"])
        except (OSError, HTTPException):
            return


def _every(server: Server) -> list[str]:
    """Return the ids of all captures, page by page."""
    ids, before = list[str](), ""
    while page := server.ask("GET", f"/api/captures?limit=100{before}")["captures"]:
        ids += [capture["id"] for capture in page]
        before = f"&before={ids[-1]}"
    return ids


def start_damaged(data: Path, head: Path, number: int) -> None:
    """Damage one file of a copy of the store, start the instrument on it, and count the starts that fail."""
    planned = plan(1000)
    draw = random.Random(40)
    failed, missing = 0, 0
    with CaptureStore(data) as store:
        stored = {capture.id for capture in store.captures(100_000)}
    for turn in range(number):
        trial = planned[draw.randrange(len(planned))]
        folder = shutil.copytree(data, data.with_name(f"damaged-{turn}"))
        if not (paths := targets(folder, trial.target)):
            paths = targets(folder, "database")
        DAMAGES[trial.damage](folder, paths, draw)
        server = Server(head, folder, {})
        try:
            with server.running():
                health = {check["name"]: check for check in server.ask("GET", "/api/health")["checks"]}
                missing += bool(stored - set(_every(server))) and health["captures"]["ok"]
        except AssertionError:
            failed += 1
        shutil.rmtree(folder)
    timing.head("starts on a damaged store", "starts", "failed", "silent")
    timing.row("one file damaged", str(number), str(failed), str(missing))


def measure_openings(folder: Path) -> None:
    """Print the time of opening a store with its records in order, and of rebuilding its database."""
    timing.head("opening a store", "captures", "open s", "rebuild s")
    files = dict.fromkeys(REQUIRED_FILES, b"content")
    for number in CAPTURES:
        place, clock = folder / f"store-{number}", SystemClock()
        with CaptureStore(place, reserve_bytes=0) as store:
            for k in range(number):
                report = CaptureReport(verdict=StoredVerdict("good", numbers={"level": 0.25}))
                store.save(Capture(f"c{k}", "OD", clock.wall(), True, "00ff", report, {}), files)
        timing.row("records in files", str(number), _opening_s(place), _rebuilding_s(place))
        shutil.rmtree(place)


def _opening_s(place: Path) -> float:
    begin = time.perf_counter()
    CaptureStore(place, reserve_bytes=0).close()
    return time.perf_counter() - begin


def _rebuilding_s(place: Path) -> float:
    (place / "store.sqlite").unlink()
    return _opening_s(place)


if __name__ == "__main__":
    main()
