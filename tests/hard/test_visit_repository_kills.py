"""Kills of the visit repository: acknowledged answers survive, and a repeated request is idempotent.

Run as a script, this file is the victim process: it begins a visit and stores answers until it is killed.
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
from services.records.capture_store import CaptureStore
from services.records.programme import load_programme
from services.records.visit_repository import VisitRepository

ROUNDS = 6
MEMORY = Path("/dev/shm")
ROOT = Path(__file__).parents[2]


def repository_of(store: CaptureStore) -> VisitRepository:
    return VisitRepository(store.engine, load_programme(), SystemClock())


def key(round_number: int, number: int) -> str:
    return f"{round_number:04x}{number:012x}"


def test_acknowledged_answers_survive_a_kill_and_a_repeat_is_idempotent() -> None:
    random_source = random.Random(3)
    with TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
        for round_number in range(ROUNDS):
            acknowledged = killed_after(random_source.uniform(0, 0.15), Path(folder), round_number)
            assert acknowledged, "killed before the first acknowledgement"
            with CaptureStore(Path(folder), reserve_bytes=0) as store:
                people = repository_of(store)
                visit = people.get(people.begin(key(round_number, 0)).id)  # repeated request: the same visit
                assert len(people.visits(100)) == round_number + 1
                age = visit.fields.get("age", 0)
                assert age in (
                    acknowledged[-1],
                    acknowledged[-1] + 1,
                )  # at most one answer was stored and not acknowledged
                again = (
                    people.answer(key(round_number, acknowledged[-1]), visit.id, "age", acknowledged[-1])
                    if acknowledged[-1]
                    else visit
                )
                assert again.fields.get("age", 0) == age  # a late repeat changes nothing


def killed_after(seconds: float, folder: Path, round_number: int) -> list[int]:
    """Return the answers that the victim had acknowledged when it was killed, `seconds` after the first."""
    victim = subprocess.Popen(
        [sys.executable, "-W", "error", __file__, str(folder), str(round_number)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
    )
    assert victim.stdout is not None
    first = victim.stdout.readline()
    time.sleep(seconds)
    victim.send_signal(signal.SIGKILL)
    lines = (first + victim.stdout.read()).decode().split("\n")[:-1]  # the last line may be incomplete
    victim.stdout.close()
    assert victim.wait(10) == -signal.SIGKILL
    return [int(line) for line in lines]


if __name__ == "__main__":
    with CaptureStore(Path(sys.argv[1]), reserve_bytes=0) as store:
        repository, which = repository_of(store), int(sys.argv[2])
        begun = repository.begin(key(which, 0)).id
        print(0, flush=True)  # noqa: T201
        for answer in range(1, 126):
            repository.answer(key(which, answer), begun, "age", answer)
            print(answer, flush=True)  # noqa: T201
        time.sleep(60)
