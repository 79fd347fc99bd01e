"""Keeping, killed: at every line, at random moments, and with the disk's promises written down in order.

Run as a script, this file is the victim: it forks, and each child keeps until it is killed.
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

from device.values import Capture
from services.records import store as product
from services.records.store import Store

ROOM = str(Path(product.__file__).parent)
FILES = {"raw.tiff": bytes(range(256)) * 40, "picture.png": b"png" * 300, "report.json": b"{}"}
ROUNDS = 8
MEMORY = Path("/dev/shm")


@pytest.fixture
def shelves() -> Iterator[Path]:
    """A folder in memory where there is one: a kill cannot tell, and a hundred shelves take seconds, not a minute."""
    with TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
        yield Path(folder)


def capture(name: str, second: int = 0) -> Capture:
    taken_at = datetime(2026, 3, 1, 12, tzinfo=UTC) + timedelta(seconds=second)
    return Capture(name, "OS", taken_at, False, "00ff", {"method": "wiener"}, {})


def is_whole(store: Store, id: str) -> bool:
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


def test_a_kill_at_any_line_leaves_a_capture_kept_or_torn_and_nothing_between(shelves: Path) -> None:
    where = run_victim("lines", shelves).split()
    outcomes = [judge(shelves / f"{number:03}", line) for number, line in enumerate(where)]
    assert len(where) > 40
    assert where[-1] == "survived"
    assert outcomes == sorted(outcomes, key=["untouched", "torn", "torn whole", "kept"].index)  # and never back
    assert set(outcomes) == {"untouched", "torn", "torn whole", "kept"}


def judge(folder: Path, line: str) -> str:
    """What the next opening makes of a shelf on which "new" was being kept."""
    with Store(folder, reserve_bytes=0) as store:
        listed = [kept.id for kept in store.captures()]
        assert is_whole(store, "before"), line
        assert {path.name for path in (folder / "captures").iterdir()} == set(listed), line
        torn = {path.name: path.read_bytes() for path in (folder / "torn").glob("new/*")}
        if "new" in listed:
            assert (is_whole(store, "new"), store.swept, torn) == (True, (), {}), line
            return "kept"
        assert all(FILES[name].startswith(content) for name, content in torn.items()), line
        assert store.swept in ((), ("new",)), line
        assert (folder / "torn" / "new").exists() == bool(store.swept), line
        if folder.name.endswith("5"):  # the name is free again; every tenth shelf tells
            store.keep(capture("new", 1), FILES)
            assert is_whole(store, "new"), line
    return ("torn whole" if torn == FILES else "torn") if store.swept else "untouched"


def test_what_was_said_to_be_kept_survives_kills_at_random_moments(shelves: Path) -> None:
    said = run_victim("moments", shelves).split()
    assert len(said) > ROUNDS
    with Store(shelves / "shelf") as store:
        listed = [kept.id for kept in store.captures(limit=100_000)]
        assert set(said) <= set(listed)
        assert len(listed) <= len(said) + ROUNDS  # at most one per kill was kept and not yet said
        assert all(is_whole(store, id) for id in listed)


def test_each_step_is_on_the_disk_before_the_next_begins(tmp_path: Path) -> None:
    """A kill does not lose what the kernel holds; a power cut does. So the order of the calls themselves is watched."""
    seen: list[str] = []

    def watch(frame: FrameType, event: str, called: Any) -> None:
        name = getattr(called, "__name__", "") if event == "c_call" else ""
        if name == "fsync":
            seen.append("fsync " + Path(os.readlink(f"/proc/self/fd/{frame.f_locals['descriptor']}")).name)
        elif name == "rename":
            seen.append("rename")
        elif name in ("execute", "executemany") and "statement" in frame.f_locals:
            seen.append(str(frame.f_locals["statement"]).split("(", 1)[0].strip())

    with Store(tmp_path, reserve_bytes=0) as store:
        previous = sys.getprofile()
        sys.setprofile(watch)
        try:
            store.keep(capture("new"), FILES)
        finally:
            sys.setprofile(previous)
    files = [f"fsync {name}" for name in FILES]
    assert sorted(seen[:3]) == sorted(files)
    assert seen[3:6] == ["fsync .new.part", "rename", "fsync captures"]
    assert seen[6:] == ["BEGIN IMMEDIATE", "INSERT INTO captures", "INSERT INTO files"]


# The victim.


def killed_at_every_line(folder: Path) -> None:
    """Keep once for each line of the room that keeping runs, killed there; print the lines."""
    with Store(folder / "template", reserve_bytes=0) as store:
        store.keep(capture("before"), FILES)
    for number in count():
        shelf = folder / f"{number:03}"
        shutil.copytree(folder / "template", shelf)
        status = in_child(lambda shelf=shelf, number=number: keep_until_line(shelf, number, folder / "line"))
        print("survived" if status == 0 else (folder / "line").read_text())  # noqa: T201
        if status == 0:
            return
        assert os.WTERMSIG(status) == signal.SIGKILL


def keep_until_line(shelf: Path, number: int, note: Path) -> None:
    lines = count()

    def trace(frame: FrameType, event: str, _: Any) -> Callable[..., Any] | None:
        if not frame.f_code.co_filename.startswith(ROOM):
            return None
        if event == "line" and next(lines) == number:
            note.write_text(f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}")
            os.kill(os.getpid(), signal.SIGKILL)
        return trace

    store = Store(shelf, reserve_bytes=0)
    sys.settrace(trace)
    store.keep(capture("new", 1), FILES)


def killed_at_random_moments(folder: Path) -> None:
    """Keep without end, killed and begun again; print what keeping said was kept."""
    chance = random.Random(7)
    for round_number in range(ROUNDS):
        reader, writer = os.pipe()
        pid = os.fork()
        if pid == 0:
            keep_without_end(folder / "shelf", round_number, writer)
        os.close(writer)
        first = os.read(reader, 100)  # it is under way
        time.sleep(chance.uniform(0, 0.12))
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        with os.fdopen(reader, "rb") as rest:
            print((first + rest.read()).decode())  # noqa: T201


def keep_without_end(shelf: Path, round_number: int, writer: int) -> None:
    store = Store(shelf, reserve_bytes=0)
    for number in count():
        kept = store.keep(capture(f"{round_number}-{number}", number), FILES)
        os.write(writer, f"{kept.id}\n".encode())


def in_child(work: Callable[[], None]) -> int:
    """The exit status of a fork that does `work`."""
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        work()
        os._exit(0)
    return os.waitpid(pid, 0)[1]


if __name__ == "__main__":
    {"lines": killed_at_every_line, "moments": killed_at_random_moments}[sys.argv[1]](Path(sys.argv[2]))
