"""Answers, killed: what was acknowledged is there after any kill, and the repeated request does nothing twice.

Run as a script, this file is the victim: it begins a visit and answers without end until it is killed.
"""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from device.clock import SystemClock
from services.records.people import People
from services.records.protocol import load_protocol
from services.records.store import Store

ROUNDS = 6
MEMORY = Path("/dev/shm")
ROOT = Path(__file__).parents[2]


def opened(store: Store) -> People:
    return People(store.engine, load_protocol(), SystemClock())


def key(round_number: int, number: int) -> str:
    return f"{round_number:04x}{number:012x}"


def test_every_acknowledged_answer_survives_a_kill_and_a_repeat_is_harmless() -> None:
    chance = random.Random(3)
    with TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
        for round_number in range(ROUNDS):
            said = killed_after(chance.uniform(0, 0.15), Path(folder), round_number)
            assert said, "it was killed before it said anything"
            with Store(Path(folder), reserve_bytes=0) as store:
                people = opened(store)
                visit = people.get(people.begin(key(round_number, 0)).id)  # the same request: the same visit
                assert len(people.visits(100)) == round_number + 1
                age = visit.fields.get("age", 0)
                assert age in (said[-1], said[-1] + 1)  # at most one was written and not yet said
                again = people.answer(key(round_number, said[-1]), visit.id, "age", said[-1]) if said[-1] else visit
                assert again.fields.get("age", 0) == age  # an old request that comes late changes nothing


def killed_after(seconds: float, folder: Path, round_number: int) -> list[int]:
    """What the victim had said when it was killed, `seconds` after its first word."""
    victim = subprocess.Popen(
        [sys.executable, "-W", "error", __file__, str(folder), str(round_number)],
        cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE,
    )  # fmt: skip
    assert victim.stdout is not None
    first = victim.stdout.readline()
    time.sleep(seconds)
    victim.send_signal(signal.SIGKILL)
    lines = (first + victim.stdout.read()).decode().split("\n")[:-1]  # the last may be half a line
    victim.stdout.close()
    assert victim.wait(10) == -signal.SIGKILL
    return [int(line) for line in lines]


if __name__ == "__main__":
    with Store(Path(sys.argv[1]), reserve_bytes=0) as shelf:
        mine, which = opened(shelf), int(sys.argv[2])
        begun = mine.begin(key(which, 0)).id
        print(0, flush=True)  # noqa: T201
        for answer in range(1, 126):
            mine.answer(key(which, answer), begun, "age", answer)
            print(answer, flush=True)  # noqa: T201
        time.sleep(60)
