"""Kill tests of the calibration archive: after a kill during a write the old or the new calibration is whole."""

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
from device.calibration.signing import create_key_pair, export
from tests.project_files import ROOT
from tests.unit.test_archive import WHO, calibration

OLD, NEW = (replace(calibration(black_dn), dark_dn=None, bad=None) for black_dn in (64.25, 65.0))
KILLS = {"keep": 100, "take_in": 40, "use": 40}  # keep writes the most files
FORK_SERVER = """
import os, sys
from pathlib import Path
from device.calibration.archive import Archive
from device.calibration.signing import read_export, read_signer
from tests.hard.test_calibration_kills import NEW
from tests.unit.test_archive import WHO
root, sent, trusted = map(Path, sys.argv[1:])

def keep():
    Archive(root).add_and_activate(NEW, WHO)

def take_in():
    Archive(root).add_files(read_export(sent, (read_signer(trusted),))[0])

def use():
    Archive(root).activate(NEW.id)

for line in sys.stdin:
    child = os.fork()
    if not child:
        print(os.getpid(), flush=True)
        globals()[line.strip()]()
        print("done", flush=True)
        os._exit(0)
    sys.stdin.readline()  # until here the kernel does not reuse the process id
    os.waitpid(child, 0)
    print("gone", flush=True)
"""


@contextmanager
def fork_server(*places: Path) -> Iterator[subprocess.Popen[str]]:
    """Yield a process with all imports done, which forks one child for each action that it reads."""
    command = [sys.executable, "-c", FORK_SERVER, *map(str, places)]
    with subprocess.Popen(command, cwd=ROOT, stdin=-1, stdout=-1, text=True, bufsize=1) as process:
        yield process


def forked(process: subprocess.Popen[str], action: str) -> int:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(action + "\n")
    return int(process.stdout.readline())


def reaped(process: subprocess.Popen[str]) -> list[str]:
    """Return the output of a child after its process id, once it has ended: "done", or nothing."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("bury\n")
    return list(iter(process.stdout.readline, "gone\n"))


def prepared(place: Path, action: str) -> None:
    """Prepare the archive: the old calibration is active; for `use` the new one is stored too. Debris remains."""
    archive = Archive(place)
    if action == "use":
        archive.add(NEW, WHO)
    else:
        shutil.rmtree(place / NEW.id, ignore_errors=True)
    if (place / OLD.id).is_dir():
        (place / "current").write_text(OLD.id)  # without fsync
    else:
        archive.add_and_activate(OLD, WHO)


@pytest.mark.parametrize("action", KILLS)
def test_a_kill_leaves_the_old_or_the_new_calibration_whole(action, tmp_path, record_property):
    create_key_pair(tmp_path / "key", "Service centre")
    elsewhere, place, sent = Archive(tmp_path / "elsewhere"), tmp_path / "here", tmp_path / "sent"
    export(elsewhere.files(elsewhere.add(NEW, WHO)), sent, tmp_path / "key")
    draw, seen = random.Random(action), Counter()
    with fork_server(place, sent, tmp_path / "key.pub") as process:
        longest_s = 0.01
        for _ in range(KILLS[action]):
            prepared(place, action)
            child = forked(process, action)
            time.sleep(draw.uniform(0, longest_s))
            os.kill(child, signal.SIGKILL)
            done = bool(reaped(process))
            longest_s *= 0.8 if done else 1.08  # about one in four comes too late, on any machine
            archive = Archive(place)
            in_force = archive.load().calibration.id  # load checks every byte
            assert in_force in ({OLD.id, NEW.id} if action != "take_in" else {OLD.id})
            kept = {archive.load(id).calibration.id for id in archive.ids()}
            assert {in_force, OLD.id} <= kept <= {OLD.id, NEW.id}
            seen["done" if done else "killed"] += 1
            seen["torn" if list(place.glob(".part*")) else "no debris"] += 1
            seen["with it" if NEW.id in (kept if action == "take_in" else {in_force}) else "as before"] += 1
    record_property(action, dict(seen))
    assert seen["killed"] >= KILLS[action] // 2
    assert seen["as before"]
    assert seen["with it"]
    assert action == "use" or seen["torn"]
