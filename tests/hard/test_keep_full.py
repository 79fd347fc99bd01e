"""Keeping on a disk that is really full: in the files, in the folders, in the database.

Run as a script, this file is the one that keeps: on a disk of its own, or with a limit on the length of a file.
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
from device.values import Capture
from services.records.store import Store

BLOCK_BYTES = 4096
FILES = {"raw.tiff": b"r" * 18_000, "picture.png": b"p" * 3000}


def capture(name: str) -> Capture:
    return Capture(name, "OS", datetime(2026, 3, 1, 12, tzinfo=UTC), False, "00ff", {"method": "wiener"}, {})


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
    """What to put before a command so that it finds an empty disk of 2 MB at `folder`; None where nobody may mount."""
    for flags in ("-m", "-Urm") if shutil.which("unshare") else ():
        mount = 'mount -t tmpfs -o size=2m shelf "$0" && exec "$@"'
        prefix = ("unshare", flags, "sh", "-c", mount, str(folder))
        if subprocess.run([*prefix, "true"], stderr=subprocess.DEVNULL, check=False).returncode == 0:
            return prefix
    return None


def test_a_file_that_may_not_grow_is_a_full_disk_and_leaves_nothing(tmp_path: Path) -> None:
    """The limit of the operating system on the length of a file: works for everyone, everywhere."""
    said = run("limit", tmp_path)
    assert said == {
        "refused": "OSError",
        "left": ["small"],
        "listed": ["small"],
        "whole": True,
        "then": ["small", "again"],
        "swept": [],
    }


def test_a_disk_that_fills_up_anywhere_loses_nothing_and_lists_nothing_half_kept(tmp_path: Path) -> None:
    prefix = own_disk(tmp_path)
    if prefix is None:
        pytest.skip("nobody may mount here; the test with the limit on a file's length stands alone")
    said = run("disk", tmp_path, prefix)
    outcomes = [attempt["outcome"] for attempt in said["attempts"]]
    assert all(attempt["whole"] and attempt["tidy"] for attempt in said["attempts"]), said
    assert {"OSError", "OperationalError", "kept"} == set(outcomes), said  # full in the files, in the database, not
    assert outcomes[0] == "OSError"
    assert outcomes[-1] == "kept"
    assert said["opened_when_full"] in ("StoreFull", "all listed")
    assert said["swept"] == []
    assert said["whole_at_last"]


# The one that keeps.


def with_a_limit(folder: Path) -> dict[str, Any]:
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, resource.RLIM_INFINITY))
    with Store(folder, reserve_bytes=0) as store:
        store.keep(capture("small"), FILES)
        refused = attempt(store, "large", {"picture.png": b"p", "raw.tiff": bytes(1_000_001)})
        left = sorted(path.name for path in (folder / "captures").iterdir())
        listed, whole = [kept.id for kept in store.captures()], is_whole(store)
        store.keep(capture("again"), FILES)
        then = [kept.id for kept in reversed(store.captures())]
    with Store(folder) as store:
        swept = list(store.swept)
    then.sort(reverse=True)
    return {"refused": refused, "left": left, "listed": listed, "whole": whole, "then": then, "swept": swept}


def on_a_small_disk(folder: Path) -> dict[str, Any]:
    """Try with ever more room, one block at a time, until keeping succeeds thrice in a row."""
    ballast, attempts = folder / "ballast", []
    with Store(folder / "shelf", reserve_bytes=0, free_bytes=lambda folder: 10**9) as store:
        store.keep(capture("first"), FILES)
        for blocks in count():
            fill(ballast, leave_bytes=blocks * BLOCK_BYTES)
            outcome = attempt(store, f"c{blocks}", FILES)
            tidy = {path.name for path in (folder / "shelf/captures").iterdir()} == {one.id for one in store.captures()}
            attempts.append({"blocks": blocks, "outcome": outcome, "tidy": tidy, "whole": is_whole(store)})
            if [one["outcome"] for one in attempts[-3:]] == ["kept"] * 3:
                break
        fill(ballast, leave_bytes=0)
        opened = open_when_full(folder / "shelf", len(store.captures()))
        ballast.unlink()
        number = len(store.captures())
    with Store(folder / "shelf", reserve_bytes=0) as store:
        store.keep(capture("last"), FILES)
        whole = is_whole(store) and len(store.captures()) == number + 1
        return {"attempts": attempts, "opened_when_full": opened, "swept": list(store.swept), "whole_at_last": whole}


def open_when_full(folder: Path, number: int) -> str:
    try:
        with Store(folder, reserve_bytes=0) as store:
            return "all listed" if len(store.captures()) == number else "something is gone"
    except StoreFull:
        return "StoreFull"


def attempt(store: Store, name: str, files: dict[str, bytes]) -> str:
    """What keeping said: "kept", or what stood behind its StoreFull."""
    try:
        store.keep(capture(name), files)
    except StoreFull as full:
        return type(full.__cause__).__name__
    return "kept"


def is_whole(store: Store) -> bool:
    return all({name: store.read(kept.id, name) for name in kept.files} == FILES for kept in store.captures())


def fill(ballast: Path, leave_bytes: int) -> None:
    """Make the disk full but for `leave_bytes`."""
    ballast.unlink(missing_ok=True)
    free_bytes = shutil.disk_usage(ballast.parent).free
    ballast.write_bytes(bytes(max(0, free_bytes - leave_bytes)))


if __name__ == "__main__":
    print(json.dumps({"limit": with_a_limit, "disk": on_a_small_disk}[sys.argv[1]](Path(sys.argv[2]))))  # noqa: T201
