"""The ladder of recipes: stages, deadlines, colour, memory, and no planning on a press."""

import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from device.clock import Deadline, VirtualClock
from device.recon.geometry import Grid
from device.recon.methods import METHODS
from device.recon.plan import Planner
from device.recon.reconstructor import Recipe, Reconstructor, Stage
from tests import scenes

SHAPE = (96, 128)
QUICK, FULL = Recipe("gradient", 4), Recipe("gradient", 1)


class SlowClock(VirtualClock):
    """Virtual time in which every look at the clock costs a tenth of a second."""

    def now_s(self) -> float:
        self.elapsed_s += 0.1
        return self.elapsed_s


def counts(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(500, 1500, SHAPE).astype(np.uint16)


def test_stages_come_in_order_and_the_last_says_so() -> None:
    seen: list[Stage] = []
    reconstruct = scenes.reconstructor(scenes.calibration(scenes.speckle(SHAPE)), SHAPE, QUICK, FULL)
    result = reconstruct(counts(), watch=seen.append)
    assert [(stage.recipe.bin, stage.last) for stage in seen] == [(4, False), (1, True)]
    assert seen[0].picture.shape == (24, 32)
    assert result.picture.shape == SHAPE
    assert result.report.stopped == "done"


def test_a_passed_deadline_still_gives_the_quick_look() -> None:
    clock = SlowClock()
    cal = scenes.calibration(scenes.speckle(SHAPE))
    reconstruct = Reconstructor(cal, SHAPE, scenes.PLANNER, clock, (QUICK, FULL))
    deadline = Deadline.after(clock, 0.05)
    result = reconstruct(counts(), deadline=deadline)
    assert (result.report.bin, result.report.stopped) == (4, "deadline")
    assert result.picture.shape == SHAPE


def test_three_channels_are_three_pictures() -> None:
    reconstruct = scenes.reconstructor(scenes.calibration(scenes.speckle(SHAPE)), SHAPE)
    colour = np.stack([counts(1), counts(2), counts(3)], axis=-1)
    together = reconstruct(colour).picture
    for c in range(3):
        alone = reconstruct(np.ascontiguousarray(colour[..., c])).picture
        assert together[..., c] == pytest.approx(alone, abs=1e-3)


def test_a_press_never_plans() -> None:
    planner = Planner(folder=None, threads=1, effort="FFTW_ESTIMATE")
    reconstruct = Reconstructor(
        scenes.calibration(scenes.speckle(SHAPE)), SHAPE, planner, VirtualClock(), (QUICK, FULL)
    )
    planned = planner.planned
    reconstruct(counts())
    assert planner.planned == planned


def test_wisdom_is_kept_and_a_damaged_file_costs_only_time(tmp_path) -> None:
    shape = (154, 286)  # of no other test: FFTW keeps what it has learnt for the whole process
    Planner(tmp_path, threads=1).plan(shape)
    (file,) = tmp_path.glob("*.wisdom")
    file.write_text("no wisdom at all")
    fft = Planner(tmp_path, threads=1).plan(shape)
    fft.space[:] = 1
    assert fft.forward()[0, 0] == pytest.approx(154 * 286)


def test_what_a_solve_allocates_does_not_grow_with_the_image() -> None:
    def peak_bytes(shape: tuple[int, int]) -> int:
        reconstruct = scenes.reconstructor(scenes.calibration(scenes.speckle(shape)), shape)
        y = np.full(shape, 700, np.uint16)
        rung = reconstruct.rungs[0]
        tracemalloc.start()
        rung.solver.start(rung.preparer(y))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    small, large = peak_bytes((256, 256)), peak_bytes((1024, 1024))
    # the frequencies that decide are capped at 20 000, so sixteen times the pixels may not need twice the scratch
    assert large < 2 * small


def test_memory_is_known_before_it_is_taken() -> None:
    inf = float("inf")
    for method in METHODS.values():
        asked = method.memory_bytes(Grid.periodic((1080, 1920), 1, inf))
        assert 60e6 < asked < 300e6
        assert method.memory_bytes(Grid.periodic((1080, 1920), 2, inf)) < asked


@pytest.mark.parametrize("method", METHODS)
def test_known_memory_is_what_is_taken(method: str) -> None:
    shape = (512, 640)
    even = np.ones(shape, np.float32)  # a map of the sensor's dark and one of its response, as a head has
    cal = scenes.calibration(scenes.speckle(shape), dark_dn=even, flat=even)
    scenes.reconstructor(cal, shape, Recipe(method, 1))  # compiles, which also takes memory
    tracemalloc.start()
    kept = scenes.reconstructor(cal, shape, Recipe(method, 1))
    taken = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert kept.rungs
    assert taken == pytest.approx(METHODS[method].memory_bytes(kept.rungs[0].grid), rel=0.25)


def test_one_bad_moment_does_not_refuse_the_good_picture_for_ever() -> None:
    clock = VirtualClock()
    cal = scenes.calibration(scenes.speckle(SHAPE))
    reconstruct = Reconstructor(cal, SHAPE, scenes.PLANNER, clock, (QUICK, FULL))
    reconstruct.rungs[1].start_cost.add(60.0)  # a neighbour held the machine for a minute
    bins = [reconstruct(counts(), deadline=Deadline.after(clock, 1.0)).report.bin for _ in range(15)]
    assert bins[0] == 4
    assert bins[-1] == 1


COMPILED_ON_A_PRESS = """
import numpy as np
from device.recon import kernels, sweeps
from tests import scenes

def compiled():
    both = {**vars(kernels), **vars(sweeps)}.items()
    return {(name, str(types)) for name, f in both if hasattr(f, "signatures") for types in f.signatures}

cal = scenes.calibration(scenes.speckle((48, 64)))
make = scenes.reconstructor(cal, (48, 64), scenes.Recipe("evidence", 2), scenes.Recipe("variation", 1))
before = compiled()
frame = np.random.default_rng(0).integers(500, 1500, (48, 64)).astype(np.uint16)
dark = np.zeros_like(frame)
make(frame)
frame.flags.writeable = dark.flags.writeable = False  # as a camera hands them over
make(frame)
make(frame, dark)
print(sorted(compiled() - before))
"""


def test_a_press_compiles_nothing() -> None:
    """In a process of its own, where no other test has compiled anything: a first press once took 0.8 s of 0.26 s."""
    command = [sys.executable, "-c", COMPILED_ON_A_PRESS]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stdout + done.stderr
