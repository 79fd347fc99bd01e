"""The power goes after any call of a program, and the disk forgets what was not synced: old or new, and whole."""

import random
import shutil
import sqlite3
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from tests.hard.power import Disk, noted, written
from tests.hard.power_cases import CASES, folder_of
from tests.house import ROOT

MEMORY = Path("/dev/shm")


@dataclass(frozen=True)
class Recording:
    """All cases, done once: the folder of each as it was before, and every call that was made."""

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
        yield Recording(folder, noted(words, folder, ROOT))


@pytest.mark.parametrize("name", CASES)
def test_a_power_cut_at_any_moment_leaves_the_old_or_the_new_one_whole(name: str, recording: Recording) -> None:
    case, draw, folder = CASES[name], random.Random(name), folder_of(name, recording.folder)
    disk = Disk(folder, folder_of(name, recording.folder / "before"), case.fat)
    disks, contents, outcomes = set[int](), set[int](), set[str]()
    for call in ["", *recording.calls]:
        if call and not disk.follow(call):
            continue
        said = [word for word in disk.said.partition(f"<{name}>\n")[2].partition("<")[0].split("\n") if word]
        for left in disk.cuts(draw):
            if (one := hash((tuple(left.items()), len(said)))) in disks:
                continue
            disks.add(one)
            with TemporaryDirectory(dir=recording.folder) as place:
                found = (content(written(left, Path(place) / "looked-at")), len(said))
                if hash(found) not in contents:
                    outcomes.add(case.judge(written(left, Path(place) / "left"), said))
                    contents.add(hash(found))
    print(f"{name}: {len(disks)} disks, {len(contents)} contents")  # noqa: T201  # the figures that README quotes
    assert outcomes == case.outcomes
    real = {str(path.relative_to(folder)): path.is_file() and path.read_bytes() for path in folder.rglob("*")}
    seen = {path.lstrip("/"): left is not None and left for path, left in disk.as_seen().items() if path}
    assert seen == real  # the disk in memory followed the real one, byte by byte


def content(folder: Path) -> tuple[object, ...]:
    """What is in a folder, and in its tables after SQLite has recovered them: the same rows may lie in other pages."""
    rows: list[object] = []
    for path in sorted(folder.rglob("shelf.sqlite")):
        connection = sqlite3.connect(path)
        rows += [str(path.relative_to(folder)), *connection.iterdump()]
        connection.close()
    for path in sorted(folder.rglob("*")):
        if not path.name.startswith("shelf.sqlite"):
            rows += [str(path.relative_to(folder)), path.is_file() and path.read_bytes()]
    return tuple(rows)
