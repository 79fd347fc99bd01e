"""Reconstructor: stages, deadlines, colour, memory; no FFT planning and no compilation after construction."""

import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyfftw
import pytest

from device.clock import Deadline, VirtualClock
from device.config.head_file import load_head
from device.recon.durations import LEAST_RUNS
from device.recon.methods import METHODS
from device.recon.model.fft_plans import Planner
from device.recon.model.grid import Grid
from device.recon.reconstructor import Reconstructor
from device.recon.solvers.solver import Solver
from device.recon.solvers.tv import TotalVariation
from device.recon.stage import Recipe, RoundDone, StageResult
from device.sim.simulated_calibration import simulated_calibration
from device.values import Image, Reconstruction
from tests import scenes
from tests.simulated import SCENES, coarse, exposed_counts, world

SHAPE = (96, 128)
QUICK, FULL = Recipe("gradient", 4), Recipe("gradient", 1)


class SlowClock(VirtualClock):
    """Virtual clock in which every reading takes a tenth of a second."""

    def now_s(self) -> float:
        self.elapsed_s += 0.1
        return self.elapsed_s


def counts(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(500, 1500, SHAPE).astype(np.uint16)


def test_stages_run_in_order_and_the_last_is_marked() -> None:
    reconstruct = scenes.reconstructor(scenes.calibration(scenes.speckle(SHAPE)), SHAPE, QUICK, FULL)
    *steps, result = reconstruct.steps(counts())
    seen = [step for step in steps if isinstance(step, StageResult)]
    assert isinstance(result, Reconstruction)
    assert [(stage.recipe.bin, stage.last) for stage in seen] == [(4, False), (1, True)]
    assert seen[0].picture.shape == (24, 32)
    assert result.picture.shape == SHAPE
    assert result.report.stopped == "done"


def test_a_pause_after_a_round_moves_the_deadline_and_admits_a_quick_look() -> None:
    clock, frame = VirtualClock(), counts()
    cal = scenes.calibration(scenes.speckle(SHAPE))
    reconstruct = Reconstructor(cal, SHAPE, scenes.PLANNER, clock, (QUICK, Recipe("variation", 1, 8)))
    alone, pauses = reconstruct(frame), 0
    for step in reconstruct.steps(frame, deadline=Deadline.after(clock, 1.0)):
        if isinstance(step, RoundDone):
            pauses += 1
            clock.sleep(10.0)  # longer than the deadline
            reconstruct(counts(pauses), quick=True)
    assert isinstance(step, Reconstruction)
    assert (step.report.stopped, pauses) == ("done", step.report.rounds)
    assert pauses > 3
    assert step.report.seconds["solve"] == pytest.approx(0.0)
    assert np.array_equal(step.picture, alone.picture)


def failing(counts: np.ndarray, dark: np.ndarray | None = None) -> None:
    raise AssertionError("the noise of lines is known")


def test_a_quick_look_made_before_is_the_first_stage_of_its_frame() -> None:
    reconstruct = scenes.reconstructor(scenes.calibration(scenes.speckle(SHAPE)), SHAPE, QUICK, FULL)
    alone, quick = reconstruct(counts()), reconstruct(counts(), quick=True)
    look = reconstruct.quick_look(counts())
    reconstruct.quick_look(counts(1))  # of another frame meanwhile
    reconstruct.lines = failing  # type: ignore[assignment]  # the look has this result: another search fails
    first, *_, made = reconstruct.steps(counts(), look=look)
    assert first is look.stage
    assert isinstance(made, Reconstruction)
    assert np.array_equal(made.picture, alone.picture)
    assert made.report.quality == alone.report.quality
    late = reconstruct.steps(counts(), look=look, deadline=Deadline(VirtualClock(), -1.0))
    *_, coarse = late
    assert isinstance(coarse, Reconstruction)
    assert np.array_equal(coarse.picture, quick.picture)


class SlowEnd:
    """Solver whose rounds take 50 ms on a virtual clock, and whose end takes 0.3 s."""

    def __init__(self, solver: Solver, clock: VirtualClock) -> None:
        self._solver, self._clock = solver, clock

    def __getattr__(self, name: str) -> Any:
        return getattr(self._solver, name)

    def step(self) -> None:
        self._clock.sleep(0.05)
        self._solver.step()

    def finish(self, out: Image) -> None:
        self._clock.sleep(0.3)
        self._solver.finish(out)


def test_the_deadline_reserves_the_end_of_the_solver() -> None:
    clock = VirtualClock()
    cal = scenes.calibration(scenes.speckle(SHAPE))
    reconstruct = Reconstructor(cal, SHAPE, scenes.PLANNER, clock, (QUICK, Recipe("variation", 1, 30)))
    stage = reconstruct.stages[1]
    stage.solver = SlowEnd(stage.solver, clock)
    reconstruct(counts())  # measures the cost of its end
    begin_s = clock.now_s()
    made = reconstruct(counts(), deadline=Deadline.after(clock, 1.0))
    assert made.report.stopped == "deadline"
    assert made.report.rounds > 5
    assert clock.now_s() - begin_s <= 1.0


def test_a_single_stage_has_no_pauses() -> None:
    reconstruct = scenes.reconstructor(scenes.calibration(scenes.speckle(SHAPE)), SHAPE, Recipe("variation", 1, 8))
    assert [type(step) for step in reconstruct.steps(counts())] == [StageResult, Reconstruction]


def test_a_passed_deadline_gives_the_quick_look() -> None:
    clock = SlowClock()
    cal = scenes.calibration(scenes.speckle(SHAPE))
    reconstruct = Reconstructor(cal, SHAPE, scenes.PLANNER, clock, (QUICK, FULL))
    deadline = Deadline.after(clock, 0.05)
    result = reconstruct(counts(), deadline=deadline)
    assert (result.report.bin, result.report.stopped) == (4, "deadline")
    assert result.picture.shape == SHAPE


def test_channels_are_reconstructed_independently() -> None:
    reconstruct = scenes.reconstructor(scenes.calibration(scenes.speckle(SHAPE)), SHAPE)
    colour = np.stack([counts(1), counts(2), counts(3)], axis=-1)
    together = reconstruct(colour).picture
    for c in range(3):
        alone = reconstruct(np.ascontiguousarray(colour[..., c])).picture
        assert together[..., c] == pytest.approx(alone, abs=1e-3)


def test_reconstruction_makes_no_fft_plan() -> None:
    planner = Planner(folder=None, threads=1, effort="FFTW_ESTIMATE")
    reconstruct = Reconstructor(
        scenes.calibration(scenes.speckle(SHAPE)), SHAPE, planner, VirtualClock(), (QUICK, FULL)
    )
    planned = planner.planned
    reconstruct(counts())
    assert planner.planned == planned


def test_fftw_wisdom_is_stored_and_a_damaged_file_is_ignored(tmp_path) -> None:
    shape = (154, 286)
    pyfftw.forget_wisdom()  # FFTW accumulates it per process, and another test may have planned this shape
    Planner(tmp_path, threads=1).plan(shape)
    (file,) = tmp_path.glob("*.wisdom")
    file.write_text("no wisdom at all")
    fft = Planner(tmp_path, threads=1).plan(shape)
    fft.space[:] = 1
    assert fft.forward()[0, 0] == pytest.approx(154 * 286)


def test_solver_allocations_do_not_grow_with_the_image() -> None:
    def peak_bytes(shape: tuple[int, int]) -> int:
        reconstruct = scenes.reconstructor(scenes.calibration(scenes.speckle(shape)), shape)
        y = np.full(shape, 700, np.uint16)
        stage = reconstruct.stages[0]
        tracemalloc.start()
        stage.solver.start(stage.preparer(y))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    small, large = peak_bytes((256, 256)), peak_bytes((1024, 1024))
    # the sampled frequencies are limited to 20 000, so sixteen times the pixels need less than twice the memory
    assert large < 2 * small


def test_estimated_memory_is_plausible_and_falls_with_binning() -> None:
    inf = float("inf")
    for method in METHODS.values():
        memory_bytes = method.memory_bytes(Grid.periodic((1080, 1920), 1, inf))
        assert 60e6 < memory_bytes < 300e6
        assert method.memory_bytes(Grid.periodic((1080, 1920), 2, inf)) < memory_bytes


@pytest.mark.parametrize("method", METHODS)
def test_estimated_memory_is_the_allocated_memory(method: str) -> None:
    shape = (512, 640)
    even = np.ones(shape, np.float32)  # dark frame and flat frame, as a head has
    cal = scenes.calibration(scenes.speckle(shape), dark_dn=even, flat=even)
    scenes.reconstructor(cal, shape, Recipe(method, 1))  # compiles, which also allocates memory
    tracemalloc.start()
    reconstructor = scenes.reconstructor(cal, shape, Recipe(method, 1))
    allocated_bytes = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert reconstructor.stages
    assert allocated_bytes == pytest.approx(METHODS[method].memory_bytes(reconstructor.stages[0].grid), rel=0.25)


class CountingStarts(TotalVariation):
    """Solver that counts the frames that it solves."""

    starts = 0

    def start(self, *arguments: Any) -> None:
        self.starts += 1
        super().start(*arguments)


def test_planning_solves_noise_without_corrections() -> None:
    """Each correction is a solution of its own: they took a quarter of the time in which a head gets ready."""
    built = []

    def build(*arguments: Any) -> CountingStarts:
        built.append(CountingStarts(*arguments))
        return built[-1]

    methods = {**METHODS, "variation": replace(METHODS["variation"], build=build)}
    of = world(coarse(load_head(SCENES / "healthy.toml"), 8))
    Reconstructor(simulated_calibration(of), of.shape, scenes.PLANNER, VirtualClock(), methods=methods)
    assert [solver.starts for solver in built] == [1 + LEAST_RUNS]  # to compile, and to measure


def test_one_slow_run_does_not_refuse_the_stage_forever() -> None:
    clock = VirtualClock()
    cal = scenes.calibration(scenes.speckle(SHAPE))
    reconstruct = Reconstructor(cal, SHAPE, scenes.PLANNER, clock, (QUICK, FULL))
    reconstruct.stages[1].start_cost.add(60.0)  # another process occupied the machine for a minute
    bins = [reconstruct(counts(), deadline=Deadline.after(clock, 1.0)).report.bin for _ in range(15)]
    assert bins[0] == 4
    assert bins[-1] == 1


class StallingClock(VirtualClock):
    """Virtual clock in which every reading takes two seconds while the machine is busy, else none."""

    busy = True

    def now_s(self) -> float:
        self.elapsed_s += 2.0 if self.busy else 0.0
        return self.elapsed_s


def test_one_slow_search_does_not_refuse_the_refraction_forever() -> None:
    clock = StallingClock()
    of = world(coarse(load_head(SCENES / "short_sighted.toml"), 4))
    frame = exposed_counts(of)
    reconstruct = Reconstructor(simulated_calibration(of), of.shape, scenes.PLANNER, clock, timed=False)
    assert reconstruct(frame).report.refraction_dpt is not None
    clock.busy = False
    found = (reconstruct(frame, deadline=Deadline.after(clock, 1.0)).report.refraction_dpt for _ in range(40))
    assert next(found) is None
    assert any(eye is not None for eye in found)


PRINT_COMPILED_SIGNATURES = """
import numpy as np
from device.recon.model import fused_kernels, kernels
from tests import scenes

def compiled():
    both = {**vars(kernels), **vars(fused_kernels)}.items()
    return {(name, str(types)) for name, f in both if hasattr(f, "signatures") for types in f.signatures}

cal = scenes.calibration(scenes.speckle((48, 64)))
make = scenes.reconstructor(cal, (48, 64), scenes.Recipe("evidence", 2), scenes.Recipe("variation", 1))
before = compiled()
frame = np.random.default_rng(0).integers(500, 1500, (48, 64)).astype(np.uint16)
dark = np.zeros_like(frame)
make(frame)
frame.flags.writeable = dark.flags.writeable = False  # as frames of a camera are
make(frame)
make(frame, dark)
print(sorted(compiled() - before))
"""


def test_reconstruction_compiles_no_kernel() -> None:
    """In a process of its own, where no other test has compiled a kernel: a first press once took 0.8 s."""
    command = [sys.executable, "-c", PRINT_COMPILED_SIGNATURES]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stdout + done.stderr
