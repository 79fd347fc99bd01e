"""Installs killed at random moments: the device boots the old version or the complete new one.

`kill -9` checks the order of the steps; what a card has written after a power cut is checked in test_power.py.
"""

import os
import random
import subprocess
import time
from collections import Counter
from pathlib import Path
from signal import SIGKILL

import pytest

from tests.appliance import bench as benches
from tests.appliance import releases
from tests.appliance.bench import Bench

pytestmark = pytest.mark.systemd

CUTS = 40


def install_s(bench: Bench, bundle: Path) -> float:
    """Return the duration of an undisturbed install, s."""
    with bench.service():
        begin_s = time.monotonic()
        subprocess.run([*bench.rauc(), "install", str(bundle)], check=True, capture_output=True)
        return time.monotonic() - begin_s


def cut(bench: Bench, bundle: Path, after_s: float) -> None:
    """Start an install and kill all of its processes after `after_s`."""
    with bench.service() as service:
        asked = subprocess.Popen(
            [*bench.rauc(), "install", str(bundle)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        time.sleep(after_s)
        os.killpg(service.pid, SIGKILL)  # including a running boot chooser
        asked.kill()
        asked.wait(60)
    benches.clear(bench)


def test_device_boots_after_each_of_forty_killed_installs(tmp_path: Path) -> None:
    workshop = releases.opened(tmp_path / "workshop")
    one, two = workshop.small("one", "1.0"), workshop.small("two", "2.0")
    draw, seen = random.Random(1), Counter[str]()
    with benches.opened(tmp_path / "bench", workshop) as bench:
        bench.fill("A", one)
        whole_s = install_s(bench, two)
        bench.chooser.set_primary("A")
        for _ in range(CUTS):
            cut(bench, two, draw.uniform(0, whole_s))
            tries = bench.chooser.primary() == "B"
            slot = bench.boot()
            assert bench.version(slot) == ("2.0" if tries else "1.0")  # a slot is tried only when it is complete
            assert bench.boot() == bench.chooser.committed() == "A"
            assert bench.version("A") == "1.0"
            seen["tried" if tries else "cut before the last step" if not bench.chooser.is_good("B") else "early"] += 1
        assert seen["cut before the last step"] >= 5, seen  # some kills hit the write
        assert install_s(bench, two) > 0  # the next install succeeds
        assert (bench.boot(), bench.version("B")) == ("B", "2.0")
    print(f"{CUTS} of {CUTS} boot: {dict(seen)}, an install takes {whole_s:.2f} s")  # noqa: T201
