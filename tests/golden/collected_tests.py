"""The list of collected tests, and the mapping of renamed or removed tests to their replacements."""

import os
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

from tests.golden import compare
from tests.project_files import ROOT

OWN = "tests/golden/"  # excluded from the record
MOVED = Path(__file__).parent / "moved_tests.txt"


def collected() -> list[str]:
    """Return the node ids of all tests, including those that cannot run here, except those of the golden records.

    Each file is imported under a unique name (`importlib`), because some folders have files of the same name.
    """
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "--import-mode=importlib", "--ignore", OWN]
    plain = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    done = subprocess.run(command, cwd=ROOT, env=plain, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return sorted(line for line in done.stdout.splitlines() if "::" in line)


def grouped(ids: Iterable[str]) -> dict[str, list[str]]:
    """Return node ids by file: `FILE` -> the rest of each id, as the record holds them."""
    found: dict[str, list[str]] = {}
    for id in ids:
        file, _, rest = id.partition("::")
        found.setdefault(file, []).append(rest)
    return found


def flat(record: Mapping[str, Iterable[str]]) -> list[str]:
    """Return the node ids of a record."""
    return [f"{file}::{rest}" for file, tests in record.items() for rest in tests]


def moves(lines: Iterable[str]) -> dict[str, str]:
    """Return old name -> new name of lines `OLD -> NEW`; comments and empty lines are skipped.

    ValueError for other lines.

    A name is a folder (ends in `/`), a file, a test (all its parameters), or a test with one parameter. `OLD => NEW`
    means that OLD was removed because NEW tests the same.
    """
    found = {}
    for line in lines:
        if line.strip() and not line.startswith("#"):
            old, arrow, new = line.replace(" => ", " -> ").partition(" -> ")
            if not arrow:
                raise ValueError(f"{line!r} is not of the form `OLD -> NEW` or `OLD => NEW`")
            found[old.strip()] = new.strip()
    return found


def mapped(id: str, moved: Mapping[str, str]) -> str:
    """Return the new id of a test: the longest old name that equals the id or a leading part is replaced."""
    for old in sorted(moved, key=len, reverse=True):
        if id == old or (id.startswith(old) and (old.endswith("/") or id[len(old) :].startswith(("::", "[")))):
            return moved[old] + id[len(old) :]
    return id


def lost(recorded: Iterable[str], present: Iterable[str], moved: Mapping[str, str]) -> list[str]:
    """Return `OLD -> NEW` of every recorded test whose new id is not collected; NEW may lack a parameter."""
    there = set(present)
    there |= {id.partition("[")[0] for id in there}
    pairs = [(id, mapped(id, moved)) for id in recorded]
    return [f"{old} -> {new}" for old, new in pairs if new not in there]


def unneeded(recorded: Iterable[str], moved: Mapping[str, str]) -> list[str]:
    """Return every old name of the mapping without a recorded test."""
    known = list(recorded)
    return [old for old in moved if not any(mapped(id, {old: moved[old]}) != id for id in known)]


def write() -> Path:
    """Write the list of tests."""
    compare.write("tests", grouped(collected()))
    return compare.RECORDS / "tests.json"
