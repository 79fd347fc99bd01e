"""Power cuts after any system call, with loss of unsynced data: the result is the old or the new state, complete."""

import random
import shutil
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from tests.hard.power import Disk, record_calls, write_tree
from tests.hard.power_cases import CASES, folder_of
from tests.project_files import ROOT

MEMORY = Path("/dev/shm")


@dataclass(frozen=True)
class Recording:
    """All cases, run once: the folder of each before the run, and every system call."""

    folder: Path
    calls: list[str]


@pytest.fixture(scope="module")
def recording() -> Iterator[Recording]:
    with TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as place:
        folder = Path(place)
        for name, case in CASES.items():
            folder_of(name, folder).mkdir()
            case.prepare(folder_of(name, folder))
        shutil.copytree(folder, folder / "before")
        words = [sys.executable, "-m", "tests.hard.power_cases", str(folder)]
        yield Recording(folder, record_calls(words, folder, ROOT))


@pytest.mark.parametrize("name", CASES)
def test_a_power_cut_at_any_call_leaves_the_old_or_the_new_state_complete(name: str, recording: Recording) -> None:
    case, random_source, folder = CASES[name], random.Random(name), folder_of(name, recording.folder)
    disk = Disk(folder, folder_of(name, recording.folder / "before"), case.fat)
    disks, contents, outcomes = set[int](), set[int](), set[str]()
    for call in ["", *recording.calls]:
        if call and not disk.follow(call):
            continue
        acknowledged = [word for word in disk.output.partition(f"<{name}>\n")[2].partition("<")[0].split("\n") if word]
        for left in disk.cuts(random_source):
            if (disk_hash := hash((tuple(left.items()), len(acknowledged)))) in disks:
                continue
            disks.add(disk_hash)
            with TemporaryDirectory(dir=recording.folder) as place:
                found = (content(write_tree(left, Path(place) / "looked-at")), len(acknowledged))
                if hash(found) not in contents:
                    outcomes.add(case.judge(write_tree(left, Path(place) / "left"), acknowledged))
                    contents.add(hash(found))
    print(f"{name}: {len(disks)} disks, {len(contents)} contents")  # noqa: T201  # figures of the README
    assert outcomes == case.outcomes
    real = {str(path.relative_to(folder)): path.is_file() and path.read_bytes() for path in folder.rglob("*")}
    seen = {path.lstrip("/"): left is not None and left for path, left in disk.as_seen().items() if path}
    assert seen == real  # the simulated disk equals the real one, byte by byte


def content(folder: Path) -> tuple[object, ...]:
    """Return the files of a folder and the rows of its databases after recovery, for comparison across page layouts."""
    rows: list[object] = []
    for path in sorted(folder.rglob("store.sqlite")):
        with closing(sqlite3.connect(path)) as connection:
            try:
                rows += [str(path.relative_to(folder)), *connection.iterdump()]
            except sqlite3.DatabaseError:  # of a case with a damaged database
                rows.append(path.read_bytes())
    for path in sorted(folder.rglob("*")):
        if not path.name.startswith("store.sqlite"):
            rows += [str(path.relative_to(folder)), path.is_file() and path.read_bytes()]
    return tuple(rows)
