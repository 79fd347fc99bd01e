"""Overhead of the code around the FFT: ratios to bare planned FFT pairs in the same run."""

from collections.abc import Callable
from functools import partial

from device.clock import SystemClock
from device.recon.model.fft_plans import Planner, RealFft
from device.recon.reconstructor import Reconstructor
from device.recon.solvers.tv import TotalVariation
from device.recon.stage import Recipe
from device.sim.scene_files import SimulatedExposure
from tests.bench import timing
from tests.bench.peer_environment import peer

SHAPE = (1080, 1920)
PAIRS = (SHAPE, (540, 960), (576, 640))  # the paper's sensor, the same binned by 2, and its tight grid
CLOSED_LIMIT, ROUND_LIMIT = 1.25, 1.6
CLOSED = (Recipe("tikhonov"), Recipe("gradient"), Recipe("gradient", 2), Recipe("gradient", 3), Recipe("evidence", 2))


def closed_forms(scene: SimulatedExposure, planner: Planner) -> None:
    """Time counts to picture, with binning and upsampling, relative to one bare pair of the sensor's size."""
    makers = [
        Reconstructor(scene.calibration, SHAPE, planner, SystemClock(), (recipe,), refract=False) for recipe in CLOSED
    ]
    pair = makers[0].stages[0].model.fft
    acts: list[Callable[[], object]] = [lambda: (pair.forward(), pair.inverse())]
    acts += [partial(make, scene.counts) for make in makers]
    (pair_ms, *made_ms), (_, *ratios) = timing.against_the_first(*acts)
    timing.head("counts to picture, 1080 x 1920", "ms", "ratio", "limit")
    timing.row("one bare real FFT pair, 1080 x 1920, planned", pair_ms, 1.0)
    for recipe, ms, ratio in zip(CLOSED, made_ms, ratios, strict=True):
        limit = CLOSED_LIMIT if recipe.method != "evidence" else None  # two pairs and a fit: no limit
        timing.row(f"{recipe.method}, bin {recipe.bin}", ms, ratio, limit=limit, value=ratio)


def refraction(scene: SimulatedExposure, planner: Planner) -> None:
    """Time the refraction search: its share of a budget of one second."""
    make = Reconstructor(scene.calibration, SHAPE, planner, SystemClock())
    assert make.refractor is not None
    (ms,) = timing.side_by_side_ms(partial(make.refractor.find, scene.counts), rounds=7)
    timing.head("the eye's refraction from one frame", "ms", "share", "limit")
    timing.row("of a budget of 1 s", ms, ms / 1000, limit=0.3, value=ms / 1000)


def rounds(scene: SimulatedExposure, planner: Planner) -> None:
    """Time one ADMM round relative to the two bare pairs of its tight grid."""
    timing.head("one round of `variation`", "ms", "ratio", "limit")
    for n in (1, 2, 3):
        recipe = Recipe("variation", n)
        make = Reconstructor(scene.calibration, SHAPE, planner, SystemClock(), (recipe,), refract=False)
        make(scene.counts, rounds=1)
        shape = make.stages[0].grid.shape
        solver = make.stages[0].solver
        assert isinstance(solver, TotalVariation)

        def pairs(data: RealFft = solver.data_fft, image: RealFft = solver.model.fft) -> None:
            data.forward(), data.inverse(), image.forward(), image.inverse()

        (bare_ms, round_ms), (_, ratio) = timing.against_the_first(pairs, make.stages[0].solver.step)
        timing.row(f"two bare pairs, {shape[0]} x {shape[1]}", bare_ms, 1.0)
        timing.row(f"a round, bin {n}", round_ms, ratio, limit=ROUND_LIMIT, value=ratio)


def libraries() -> None:
    """Time a real FFT pair by each library, one thread, in turn, in the peers' environment."""
    for rows, cols in PAIRS:
        found = peer("fft_peer.py", str(rows), str(cols))
        if found is None:
            return
        timing.head(f"a real FFT pair, {rows} x {cols}, float32", "ms", "ratio")
        for name, ms in found.items():
            timing.row(name, ms, ms / next(iter(found.values())))
