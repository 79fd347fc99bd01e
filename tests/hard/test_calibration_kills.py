"""A process is killed while it keeps, takes in or puts in force a calibration: what is left is whole, old or new."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from device.calibration.archive import Archive
from device.calibration.signed import export, new_key
from tests.house import ROOT
from tests.unit.test_archive import WHO, calibration

OLD, NEW = (replace(calibration(black_dn), dark_dn=None, bad=None) for black_dn in (64.25, 65.0))
KILLS = {"keep": 100, "take_in": 40, "use": 40}  # keeping writes the most files
NURSERY = """
import os, sys
from pathlib import Path
from device.calibration.archive import Archive
from device.calibration.signed import read_export, read_signer
from tests.hard.test_calibration_kills import NEW
from tests.unit.test_archive import WHO
root, sent, trusted = map(Path, sys.argv[1:])

def keep():
    Archive(root).keep(NEW, WHO)

def take_in():
    Archive(root).adopt(read_export(sent, (read_signer(trusted),))[0])

def use():
    Archive(root).use(NEW.id)

for line in sys.stdin:
    child = os.fork()
    if not child:
        print(os.getpid(), flush=True)
        globals()[line.strip()]()
        print("done", flush=True)
        os._exit(0)
    sys.stdin.readline()  # until then its number is nobody else's
    os.waitpid(child, 0)
    print("gone", flush=True)
"""


@contextmanager
def nursery(*places: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that has imported everything, and bears one child for each word that it is told."""
    command = [sys.executable, "-c", NURSERY, *map(str, places)]
    with subprocess.Popen(command, cwd=ROOT, stdin=-1, stdout=-1, text=True, bufsize=1) as process:
        yield process


def born(process: subprocess.Popen[str], word: str) -> int:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(word + "\n")
    return int(process.stdout.readline())


def buried(process: subprocess.Popen[str]) -> list[str]:
    """What a child said after its number, before it was gone: that it is done, or nothing."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("bury\n")
    return list(iter(process.stdout.readline, "gone\n"))


def prepared(place: Path, word: str) -> None:
    """The old one in force; for `use` the new one beside it. What a kill has left stays lying about."""
    archive = Archive(place)
    if word == "use":
        archive.add(NEW, WHO)
    else:
        shutil.rmtree(place / NEW.id, ignore_errors=True)
    if (place / OLD.id).is_dir():
        (place / "current").write_text(OLD.id)  # without waiting for the disk
    else:
        archive.keep(OLD, WHO)


@pytest.mark.parametrize("word", KILLS)
def test_kills_leave_the_old_or_the_new_one_whole(word, tmp_path, record_property):
    new_key(tmp_path / "key", "Service centre")
    elsewhere, place, sent = Archive(tmp_path / "elsewhere"), tmp_path / "here", tmp_path / "sent"
    export(elsewhere.files(elsewhere.add(NEW, WHO)), sent, tmp_path / "key")
    draw, seen = random.Random(word), Counter()
    with nursery(place, sent, tmp_path / "key.pub") as process:
        longest_s = 0.01
        for _ in range(KILLS[word]):
            prepared(place, word)
            child = born(process, word)
            time.sleep(draw.uniform(0, longest_s))
            os.kill(child, signal.SIGKILL)
            done = bool(buried(process))
            longest_s *= 0.8 if done else 1.08  # about one in four comes too late, on any machine
            archive = Archive(place)
            in_force = archive.load().calibration.id  # every byte of it is checked
            assert in_force in ({OLD.id, NEW.id} if word != "take_in" else {OLD.id})
            kept = {archive.load(id).calibration.id for id in archive.ids()}
            assert {in_force, OLD.id} <= kept <= {OLD.id, NEW.id}
            seen["done" if done else "killed"] += 1
            seen["torn" if list(place.glob(".part*")) else "no debris"] += 1
            seen["with it" if NEW.id in (kept if word == "take_in" else {in_force}) else "as before"] += 1
    record_property(word, dict(seen))
    assert seen["killed"] >= KILLS[word] // 2
    assert seen["as before"]
    assert seen["with it"]
    assert word == "use" or seen["torn"]
