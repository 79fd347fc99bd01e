"""Kills of the capture store: at every line and at random times; and the order of its fsync calls.

Run as a script, this file is the victim process: it forks, and each child stores captures until it is killed.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

import pytest

from device import atomic_io
from services.errors import StoreDamaged
from services.records import blobs
from services.records import capture_store as product
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.patient_keys import PatientKeys
from services.records.record_files import CAPTURE_RECORD as RECORD

WATCHED = (str(Path(product.__file__).parent), atomic_io.__file__)  # files whose lines are traced
FILES = {"raw.tiff": bytes(range(256)) * 40, "picture.png": b"png" * 300, "report.json": b"{}"}
ROUNDS = 8
MEMORY = Path("/dev/shm")


@pytest.fixture
def folder_of_stores() -> Iterator[Path]:
    """Return a temporary folder, in memory if possible: faster for a hundred stores, and kills behave the same."""
    with TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
        yield Path(folder)


def capture(name: str, second: int = 0) -> Capture:
    taken_at = datetime(2026, 3, 1, 12, tzinfo=UTC) + timedelta(seconds=second)
    return Capture(name, "OS", taken_at, False, "00ff", CaptureReport("wiener"), {})


def is_complete(store: CaptureStore, id: str) -> bool:
    return {name: store.read(id, name) for name in store.get(id).files} == FILES


def run_victim(mode: str, folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", __file__, mode, str(folder)],
        cwd=Path(__file__).parents[2],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=120,
    )
    return done.stdout


def test_a_kill_at_any_line_leaves_a_capture_stored_or_quarantined(folder_of_stores: Path) -> None:
    where = run_victim("lines", folder_of_stores).split()
    outcomes = [judge(folder_of_stores / f"{number:03}", line) for number, line in enumerate(where)]
    assert len(where) > 40
    assert where[-1] == "survived"
    assert outcomes == sorted(outcomes, key=["untouched", "torn", "torn whole", "kept"].index)  # in this order only
    assert set(outcomes) == {"untouched", "torn", "torn whole", "kept"}


def judge(folder: Path, line: str) -> str:
    """Return the state in which the next opening finds the capture "new" that was being stored."""
    with CaptureStore(folder, reserve_bytes=0) as store:
        listed = [kept.id for kept in store.captures()]
        assert is_complete(store, "before"), line
        assert {path.name for path in (folder / "captures").iterdir()} == set(listed), line
        places = [path for path in (folder / "quarantine").glob("new/*") if path.name != RECORD]
        torn = {path.name: content(path, store.keys) for path in places}
        if "new" in listed:
            assert (is_complete(store, "new"), store.newly_quarantined, torn) == (True, (), {}), line
            return "kept"
        assert all(found in (None, FILES[name]) for name, found in torn.items()), line
        assert store.newly_quarantined in ((), ("new",)), line
        assert (folder / "quarantine" / "new").exists() == bool(store.newly_quarantined), line
        if folder.name.endswith("5"):  # the id can be used again; tested in every tenth store
            store.save(capture("new", 1), FILES)
            assert is_complete(store, "new"), line
    return ("torn whole" if torn == FILES else "torn") if store.newly_quarantined else "untouched"


def content(path: Path, keys: PatientKeys) -> bytes | None:
    """Return the plain content of a file of a capture, None of one that is incomplete."""
    try:
        return blobs.read_file(path, keys)
    except StoreDamaged:
        return None


def test_acknowledged_captures_survive_kills_at_random_times(folder_of_stores: Path) -> None:
    acknowledged = run_victim("moments", folder_of_stores).split()
    assert len(acknowledged) > ROUNDS
    with CaptureStore(folder_of_stores / "store") as store:
        listed = [kept.id for kept in store.captures(limit=100_000)]
        assert set(acknowledged) <= set(listed)
        assert len(listed) <= len(acknowledged) + ROUNDS  # at most one per kill was stored and not acknowledged
        assert all(is_complete(store, id) for id in listed)


def test_each_step_is_durable_before_the_next_begins(tmp_path: Path) -> None:
    """A power cut loses data that the kernel holds, a kill does not; so the test records the order of the calls."""
    seen: list[str] = []

    def watch(frame: FrameType, event: str, called: Any) -> None:
        name = getattr(called, "__name__", "") if event == "c_call" else ""
        if name == "fsync":
            seen.append("fsync " + Path(os.readlink(f"/proc/self/fd/{frame.f_locals['descriptor']}")).name)
        elif name == "rename":
            seen.append("rename")
        elif name in ("execute", "executemany") and "statement" in frame.f_locals:
            seen.append(str(frame.f_locals["statement"]).split("(", 1)[0].strip())

    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        previous = sys.getprofile()
        sys.setprofile(watch)
        try:
            store.save(capture("new"), FILES)
        finally:
            sys.setprofile(previous)
    files = [f"fsync {name}" for name in (*FILES, RECORD)]
    assert sorted(seen[:4]) == sorted(files)
    assert seen[4:7] == ["fsync .new.part", "rename", "fsync captures"]
    assert seen[7:10] == ["BEGIN IMMEDIATE", "INSERT INTO captures", "INSERT INTO files"]
    assert seen[10].startswith("UPDATE captures SET revision")
    assert all(statement.startswith("SELECT") for statement in seen[11:]), "the search for unsigned records"


# Victim process


def killed_at_every_line(folder: Path) -> None:
    """Store a capture once for each line that storing runs, killed at that line; print the lines."""
    with CaptureStore(folder / "template", reserve_bytes=0) as store:
        store.save(capture("before"), FILES)
    for number in count():
        own = folder / f"{number:03}"
        shutil.copytree(folder / "template", own)
        status = in_child(lambda own=own, number=number: keep_until_line(own, number, folder / "line"))
        print("survived" if status == 0 else (folder / "line").read_text())  # noqa: T201
        if status == 0:
            return
        assert os.WTERMSIG(status) == signal.SIGKILL


def keep_until_line(folder: Path, number: int, note: Path) -> None:
    lines = count()

    def trace(frame: FrameType, event: str, _: Any) -> Callable[..., Any] | None:
        if not frame.f_code.co_filename.startswith(WATCHED):
            return None
        if event == "line" and next(lines) == number:
            note.write_text(f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}")
            os.kill(os.getpid(), signal.SIGKILL)
        return trace

    store = CaptureStore(folder, reserve_bytes=0)
    sys.settrace(trace)
    store.save(capture("new", 1), FILES)


def killed_at_random_moments(folder: Path) -> None:
    """Store captures in a loop, kill and restart; print the acknowledged ids."""
    random_source = random.Random(7)
    for round_number in range(ROUNDS):
        reader, writer = os.pipe()
        pid = os.fork()
        if pid == 0:
            keep_without_end(folder / "store", round_number, writer)
        os.close(writer)
        first = os.read(reader, 100)  # the child is running
        time.sleep(random_source.uniform(0, 0.12))
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        with os.fdopen(reader, "rb") as rest:
            print((first + rest.read()).decode())  # noqa: T201


def keep_without_end(folder: Path, round_number: int, writer: int) -> None:
    store = CaptureStore(folder, reserve_bytes=0)
    for number in count():
        kept = store.save(capture(f"{round_number}-{number}", number), FILES)
        os.write(writer, f"{kept.id}\n".encode())


def in_child(work: Callable[[], None]) -> int:
    """Return the exit status of a forked child that runs `work`."""
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        work()
        os._exit(0)
    return os.waitpid(pid, 0)[1]


if __name__ == "__main__":
    {"lines": killed_at_every_line, "moments": killed_at_random_moments}[sys.argv[1]](Path(sys.argv[2]))
