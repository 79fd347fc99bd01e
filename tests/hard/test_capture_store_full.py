"""Capture store on a full disk: while files, folders or the database are written.

Run as a script, this file is the process that stores captures, on a disk of its own or with a limit on file length.
"""

import json
import os
import resource
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from device.errors import StoreFull
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore

BLOCK_BYTES = 4096
FILES = {"raw.tiff": b"r" * 18_000, "picture.png": b"p" * 3000}


def capture(name: str) -> Capture:
    return Capture(name, "OS", datetime(2026, 3, 1, 12, tzinfo=UTC), False, "00ff", CaptureReport("wiener"), {})


def run(mode: str, folder: Path, prefix: tuple[str, ...] = ()) -> Any:
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [*prefix, sys.executable, "-W", "error", __file__, mode, str(folder)],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
        stdout=subprocess.PIPE,
        check=True,
        timeout=120,
    )
    return json.loads(done.stdout)


def own_disk(folder: Path) -> tuple[str, ...] | None:
    """Return a command prefix that mounts an empty disk of 2 MB at `folder`; None without the permission to mount."""
    for flags in ("-m", "-Urm") if shutil.which("unshare") else ():
        mount = 'mount -t tmpfs -o size=2m store "$0" && exec "$@"'
        prefix = ("unshare", flags, "sh", "-c", mount, str(folder))
        if subprocess.run([*prefix, "true"], stderr=subprocess.DEVNULL, check=False).returncode == 0:
            return prefix
    return None


def test_a_limit_on_file_length_is_a_full_disk_and_leaves_no_files(tmp_path: Path) -> None:
    """The limit of the operating system on file length needs no privileges."""
    report = run("limit", tmp_path)
    assert report == {
        "refused": "OSError",
        "left": ["small"],
        "listed": ["small"],
        "whole": True,
        "then": ["small", "again"],
        "swept": [],
    }


def test_a_disk_that_fills_up_at_any_step_loses_no_capture_and_lists_no_incomplete_one(tmp_path: Path) -> None:
    prefix = own_disk(tmp_path)
    if prefix is None:
        pytest.skip("no permission to mount; only the test with a limit on file length runs")
    report = run("disk", tmp_path, prefix)
    outcomes = [attempt["outcome"] for attempt in report["attempts"]]
    assert all(attempt["whole"] and attempt["tidy"] for attempt in report["attempts"]), report
    assert {"OSError", "OperationalError", "kept"} == set(outcomes), (
        report
    )  # disk full in a file, disk full in the database, stored
    assert outcomes[0] == "OSError"
    assert outcomes[-1] == "kept"
    assert report["opened_when_full"] in ("StoreFull", "all listed")
    assert report["swept"] == []
    assert report["whole_at_last"]


# Process that stores captures


def with_a_limit(folder: Path) -> dict[str, Any]:
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, resource.RLIM_INFINITY))
    with CaptureStore(folder, reserve_bytes=0) as store:
        store.save(capture("small"), FILES)
        refused = attempt(store, "large", {"picture.png": b"p", "raw.tiff": bytes(1_000_001)})
        left = sorted(path.name for path in (folder / "captures").iterdir())
        listed, whole = [kept.id for kept in store.captures()], is_complete(store)
        store.save(capture("again"), FILES)
        then = [kept.id for kept in reversed(store.captures())]
    with CaptureStore(folder) as store:
        recovered = list(store.newly_quarantined)
    then.sort(reverse=True)
    return {"refused": refused, "left": left, "listed": listed, "whole": whole, "then": then, "swept": recovered}


def on_a_small_disk(folder: Path) -> dict[str, Any]:
    """Try with one more free block each time, until three captures in a row are stored."""
    ballast, attempts = folder / "ballast", []
    with CaptureStore(folder / "store", reserve_bytes=0, free_bytes=lambda folder: 10**9) as store:
        store.save(capture("first"), FILES)
        for blocks in count():
            fill(ballast, leave_bytes=blocks * BLOCK_BYTES)
            outcome = attempt(store, f"c{blocks}", FILES)
            tidy = {path.name for path in (folder / "store/captures").iterdir()} == {
                record.id for record in store.captures()
            }
            attempts.append({"blocks": blocks, "outcome": outcome, "tidy": tidy, "whole": is_complete(store)})
            if [trial["outcome"] for trial in attempts[-3:]] == ["kept"] * 3:
                break
        fill(ballast, leave_bytes=0)
        opened = open_when_full(folder / "store", len(store.captures()))
        ballast.unlink()
        number = len(store.captures())
    with CaptureStore(folder / "store", reserve_bytes=0) as store:
        store.save(capture("last"), FILES)
        whole = is_complete(store) and len(store.captures()) == number + 1
        return {
            "attempts": attempts,
            "opened_when_full": opened,
            "swept": list(store.newly_quarantined),
            "whole_at_last": whole,
        }


def open_when_full(folder: Path, number: int) -> str:
    try:
        with CaptureStore(folder, reserve_bytes=0) as store:
            return "all listed" if len(store.captures()) == number else "something is gone"
    except StoreFull:
        return "StoreFull"


def attempt(store: CaptureStore, name: str, files: dict[str, bytes]) -> str:
    """Return "kept", or the type of the error behind StoreFull."""
    try:
        store.save(capture(name), files)
    except StoreFull as full:
        return type(full.__cause__).__name__
    return "kept"


def is_complete(store: CaptureStore) -> bool:
    return all({name: store.read(kept.id, name) for name in kept.files} == FILES for kept in store.captures())


def fill(ballast: Path, leave_bytes: int) -> None:
    """Fill the disk except for `leave_bytes`."""
    ballast.unlink(missing_ok=True)
    free_bytes = shutil.disk_usage(ballast.parent).free
    ballast.write_bytes(bytes(max(0, free_bytes - leave_bytes)))


if __name__ == "__main__":
    print(json.dumps({"limit": with_a_limit, "disk": on_a_small_disk}[sys.argv[1]](Path(sys.argv[2]))))  # noqa: T201
