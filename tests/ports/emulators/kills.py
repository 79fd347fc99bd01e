"""Kills, stops and hangs the owner of the ring at random moments, and reads off the wire when the eye was dark."""

import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from tests.ports.emulators import victim
from tests.ports.emulators.bus.client import Bus, Seen

ROOT = Path(victim.__file__).parents[3]
DEADLY = ("SIGKILL", "SIGTERM", "exception")  # the process ends, and the guardian hears of it
LINGERING = ("SIGSTOP", "hang")  # the process stays, and only the lease ends
WAYS = DEADLY + LINGERING
LIMIT_S = 0.1


@dataclass(frozen=True)
class Death:
    """How an owner ended, in which step, and how long the LEDs shone: after its end, or in all if it lingers.

    `shone_s` is infinite if they were never seen dark again; 0 if they were dark already.
    """

    way: str
    step: str
    shone_s: float

    @property
    def allowed_s(self) -> float:
        """100 ms, after the lease if the process lingers."""
        return LIMIT_S + (victim.LEASE_S if self.way in LINGERING else 0)


def death(bus: Bus, way: str, seed: int) -> Death:
    """Start an owner, end it in that way at a moment chosen by `seed`, and watch the wire."""
    began = len(bus.messages())
    mode = {"exception": "raise", "hang": "hang"}.get(way, "work")
    owner = subprocess.Popen(
        [sys.executable, victim.__file__, mode, str(seed)],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    try:
        said = _heard(owner, until=b"d")
        if mode == "work":
            time.sleep(random.Random(seed).uniform(0, 0.2))
            ended_s = time.monotonic()
            owner.send_signal(getattr(signal, way))
        else:
            said += _heard(owner, until=b"h")
            ended_s = time.monotonic()
        time.sleep(LIMIT_S + 0.05 + (victim.LEASE_S if way in LINGERING else 0))
        seen = bus.messages()[began:]
    finally:
        owner.kill()
    said += _heard(owner)
    owner.wait()
    assert owner.stdout is not None
    owner.stdout.close()
    time.sleep(0.1)  # its guardian's last words
    last = said.replace(b"h", b"")[-1:].decode()
    return Death(way, victim.STEPS[last], shone_s(seen, 0.0 if way in LINGERING else ended_s))


def shone_s(seen: list[Seen], since_s: float) -> float:
    """How long after `since_s` the last light ended; all of it, if that began later."""
    lit = [at for at, message in enumerate(seen) if message.lit]
    if not lit:
        return 0.0
    if lit[-1] + 1 == len(seen):
        return float("inf")
    began_s = seen[max(at for at in lit if at == 0 or not seen[at - 1].lit)].at_s
    return max(0.0, seen[lit[-1] + 1].at_s - max(began_s, since_s))


def _heard(owner: "subprocess.Popen[bytes]", until: bytes = b"") -> bytes:
    """What it says, up to and with a letter, or to its end."""
    assert owner.stdout is not None
    said = b""
    while not (until and until in said) and (more := os.read(owner.stdout.fileno(), 64)):
        said += more
    if until == b"d" and not said:
        raise RuntimeError("the owner of the ring did not start")
    return said
