"""How tight the code around the FFT is: ratios to bare planned FFT pairs in the same run."""

import importlib
from collections.abc import Callable
from functools import partial
from types import ModuleType

import numpy as np
from scipy import fft as scipy_fft

from device.clock import SystemClock
from device.recon.plan import Planner
from device.recon.reconstructor import Recipe, Reconstructor
from device.sim.staged import Staged
from device.values import Image
from tests.bench import timing

SHAPE = (1080, 1920)
CLOSED_LIMIT, ROUND_LIMIT = 1.25, 1.6
CLOSED = (Recipe("tikhonov"), Recipe("gradient"), Recipe("gradient", 2), Recipe("gradient", 3), Recipe("evidence", 2))


def closed_forms(scene: Staged, planner: Planner) -> None:
    """Counts to picture, binning and upsampling included, against one bare pair of the sensor's size.

    The pair is `tikhonov`'s own: two plans of one shape differ by up to a half on one machine, as their arrays come to
    lie on large pages of memory or on small ones.
    """
    makers = [
        Reconstructor(scene.calibration, SHAPE, planner, SystemClock(), (recipe,), refract=False) for recipe in CLOSED
    ]
    pair = makers[0].rungs[0].model.fft
    acts: list[Callable[[], object]] = [lambda: (pair.forward(), pair.inverse())]
    acts += [partial(make, scene.counts) for make in makers]
    (pair_ms, *made_ms), (_, *ratios) = timing.against_the_first(*acts)
    timing.head("counts to picture, 1080 x 1920", "ms", "ratio", "limit")
    timing.row("one bare real FFT pair, 1080 x 1920, planned", pair_ms, 1.0)
    for recipe, ms, ratio in zip(CLOSED, made_ms, ratios, strict=True):
        limit = CLOSED_LIMIT if recipe.method != "evidence" else None  # two pairs and a fit: not one closed form
        timing.row(f"{recipe.method}, bin {recipe.bin}", ms, ratio, limit=limit, value=ratio)


def rounds(scene: Staged, planner: Planner) -> None:
    """One ADMM round against the two bare pairs of its own tight grid."""
    timing.head("one round of `variation`", "ms", "ratio", "limit")
    for n in (1, 2, 3):
        recipe = Recipe("variation", n)
        make = Reconstructor(scene.calibration, SHAPE, planner, SystemClock(), (recipe,), refract=False)
        make(scene.counts, rounds=1)
        shape = make.rungs[0].grid.shape
        one, other = make.rungs[0].solver._data, make.rungs[0].solver._image

        def pairs(one=one, other=other) -> None:
            one.forward(), one.inverse(), other.forward(), other.inverse()

        (bare_ms, round_ms), (_, ratio) = timing.against_the_first(pairs, make.rungs[0].solver.step)
        timing.row(f"two bare pairs, {shape[0]} x {shape[1]}", bare_ms, 1.0)
        timing.row(f"a round, bin {n}", round_ms, ratio, limit=ROUND_LIMIT, value=ratio)


def libraries(planner: Planner) -> None:
    """The same pair by the libraries that could do it; float32 throughout, one thread each."""
    pair = planner.plan(SHAPE)
    image = np.random.default_rng(0).random(SHAPE, np.float32)
    acts: dict[str, Callable[[], object]] = {
        "pyFFTW, planned in place": lambda: (pair.forward(), pair.inverse()),
        "scipy.fft": lambda: scipy_fft.irfft2(scipy_fft.rfft2(image), SHAPE, overwrite_x=True),
    }
    ducc0 = installed("ducc0")
    if ducc0 is not None:
        acts["ducc0"] = partial(ducc_pair, ducc0, image)
    times_ms, ratios = timing.against_the_first(*acts.values())
    timing.head("a real FFT pair, 1080 x 1920, float32", "ms", "ratio")
    for name, ms, ratio in zip(acts, times_ms, ratios, strict=True):
        timing.row(name, ms, ratio)
    if ducc0 is None:
        print("ducc0 is not installed here, so it is left out")


def installed(name: str) -> ModuleType | None:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        return None


def ducc_pair(ducc0: ModuleType, image: Image) -> Image:
    spectrum = ducc0.fft.r2c(image, nthreads=1)
    return np.asarray(ducc0.fft.c2r(spectrum, lastsize=image.shape[1], forward=False, inorm=2, nthreads=1))
