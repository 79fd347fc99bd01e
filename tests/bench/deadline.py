"""`make bench-deadline`: pictures within time budgets beside a loaded processor.

One press of each kind in turn, from the frames in memory: four frames of an eye of 1.5 dioptres with refraction and
joining, and the first of them without either. A picture is late if it is over its budget by more than the 99th
percentile of the delay with which a thread of the same process wakes from sleeps of 5 ms in the same run. Columns: late
presses in %; median and 99th percentile of the time over the budget in ms (negative: in time); that delay in ms; mean
rounds of the last stage; presses in % that state a refraction, and whose PSF is that of the eye; mean number of joined
frames; median of PCC and its first percentile. The third row of a budget is the larger loss of both by refraction and
joining. Exit status 1 if more than 1 % are late, or if that loss is more than 0.002.
"""

import argparse
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Thread

import numpy as np

from device.clock import Deadline, SystemClock
from device.config.head_file import load_head
from device.errors import SettingError
from device.recon.burst_reconstructor import BurstReconstructor
from device.recon.frame_run import EyePsf
from device.recon.model.fft_plans import Planner
from device.recon.reconstructor import Reconstructor
from device.sim.scene_files import expose
from device.sim.simulated_calibration import simulated_calibration
from device.values import Reconstruction
from tests.bench.scoring import judge_of_truth
from tests.bench.timing import head, row
from tests.simulated import SCENES, with_keys

PRESSES, LOAD, FRAMES, M_DPT = 200, 4, 4, 1.5
BUDGETS_S = (0.05, 0.1, 0.26, 1.0)
SLEEP_S = 0.005
MOST_LATE, MOST_LOST_PCC = 0.01, 0.002
WITH, WITHOUT = "refraction, joining", "one frame, stored PSF"


@dataclass
class Presses:
    """Presses of one kind with one budget: seconds over it, reports, and PCC of the pictures within the field."""

    over_s: list[float] = field(default_factory=list)
    made: list[Reconstruction] = field(default_factory=list)
    pcc: list[float] = field(default_factory=list)

    @property
    def floor(self) -> tuple[float, float]:
        """Median and first percentile of PCC."""
        return float(np.median(self.pcc)), float(np.percentile(self.pcc, 1))

    def printed(self, name: str, delay_s: float) -> float:
        """Print the row, and return the share of late presses."""
        late = float(np.mean(np.asarray(self.over_s) > delay_s))
        over_ms = [float(1e3 * np.percentile(self.over_s, share)) for share in (50, 99)]
        reports = [one.report for one in self.made]
        rounds = float(np.mean([report.rounds for report in reports]))
        stated = float(np.mean([_is_stated(report.refraction_dpt) for report in reports]))
        used = float(np.mean([report.psf_scale != 1 for report in reports]))
        joined = float(np.mean([max(sum(use.used for use in report.frames), 1) for report in reports]))
        cells = (100 * late, *over_ms, 1e3 * delay_s, rounds, 100 * stated, 100 * used, joined, *self.floor)
        row(name, *cells, limit=100 * MOST_LATE, value=100 * late)
        return late


def _is_stated(refraction: object) -> bool:
    return isinstance(refraction, dict) and refraction.get("sphere") is not None


class Press:
    """Planned press of each kind, on one scene."""

    def __init__(self, planner: Planner) -> None:
        spec = with_keys(load_head(SCENES / "diabetic.toml"), eye={"m_dpt": M_DPT})
        world, self._frames = expose(spec, count=FRAMES)
        calibration = simulated_calibration(world)
        self.clock = SystemClock()
        self._judge = judge_of_truth(world.truth(spec.light.colour), None, calibration)
        single = Reconstructor(calibration, world.shape, planner, self.clock)
        self._bursts = BurstReconstructor(single, planner)

    def __call__(self, kind: str, budget_s: float, to: Presses) -> None:
        """Make a picture of this kind within the budget, and add it to its presses."""
        frames = self._frames if kind == WITH else self._frames[:1]
        eye_psf = EyePsf.ESTIMATED if kind == WITH else EyePsf.STORED
        deadline = Deadline.after(self.clock, budget_s)
        *_, made = self._bursts.steps(frames, simulated=True, deadline=deadline, eye_psf=eye_psf)
        to.over_s.append(-deadline.left_s())
        assert isinstance(made, Reconstruction)
        to.made.append(Reconstruction(made.picture[:1], made.report, made.simulated))
        to.pcc.append(self._judge(made.picture).pcc)


@contextmanager
def wake_delays_s() -> Iterator[list[float]]:
    """Yield the list to which a thread adds how much longer than SLEEP_S each of its sleeps takes, until the exit."""
    delays_s: list[float] = []
    done = Event()

    def sleep() -> None:
        while not done.is_set():
            begin_s = time.monotonic()
            time.sleep(SLEEP_S)
            delays_s.append(time.monotonic() - begin_s - SLEEP_S)

    thread = Thread(target=sleep, name="wake-delays")
    thread.start()
    try:
        yield delays_s
    finally:
        done.set()
        thread.join()


@contextmanager
def loaded(workers: int) -> Iterator[None]:
    """Load the processor with `workers` processes until the exit; SettingError without stress-ng."""
    program = shutil.which("stress-ng")
    if program is None:
        raise SettingError("stress-ng is not installed", "Run make bench-deadline, which installs it.")
    command = [program, "--quiet", "--cpu", str(workers)]
    with subprocess.Popen(command, start_new_session=True) as load:  # another program, as one from another terminal
        try:
            yield
        finally:
            load.terminate()


def deadlines(
    planner: Planner, presses: int = PRESSES, budgets_s: tuple[float, ...] = BUDGETS_S, workers: int = LOAD
) -> bool:
    """Print the figures of each budget; return whether all limits are kept."""
    press = Press(planner)
    columns = ("late %", "over ms", "p99", "delay", "rounds", "stated %", "used %", "frames", "PCC", "p1", "limit")
    head(f"{presses} presses of each kind, stress-ng --cpu {workers}", *columns)
    is_kept = True
    with loaded(workers):
        for budget_s in budgets_s:
            kinds = {WITH: Presses(), WITHOUT: Presses()}
            with wake_delays_s() as delays_s:
                for _ in range(presses):
                    for kind, to in kinds.items():
                        press(kind, budget_s, to)
            delay_s = float(np.percentile(delays_s, 99))
            late = max([to.printed(f"{budget_s:g} s, {kind}", delay_s) for kind, to in kinds.items()])
            pairs = zip(kinds[WITH].floor, kinds[WITHOUT].floor, strict=True)
            lost = max(other - own for own, other in pairs)
            row(f"{budget_s:g} s, PCC lost by them", lost, limit=MOST_LOST_PCC, value=lost)
            is_kept &= late <= MOST_LATE and lost <= MOST_LOST_PCC
    return is_kept


def main() -> int:
    """Print the table; return 1 if a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--presses", type=int, default=PRESSES, help="presses of each kind and budget")
    parser.add_argument("--budget-s", type=float, action="append", help="just this budget; may be repeated")
    parser.add_argument("--load", type=int, default=LOAD, help="workers of stress-ng")
    words = parser.parse_args()
    planner = Planner(Path.home() / ".cache" / "diffuscope")
    return 0 if deadlines(planner, words.presses, tuple(words.budget_s or BUDGETS_S), words.load) else 1


if __name__ == "__main__":
    sys.exit(main())
