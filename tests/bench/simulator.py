"""Cost of a simulated frame relative to its bare FFTs, and the saving by skipped effects."""

import time
from functools import partial
from pathlib import Path

import numpy as np
from scipy import fft

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.sim.plan import decide
from device.sim.render import cached_psf, electrons_per_s
from device.sim.world import World
from tests.bench import timing

SCENE = Path("device/sim/scenes/healthy.toml")
SKIPPED_LIMIT = 0.2  # share of the full cost, for a relaxed eye on the axis before a self-luminous screen
TURNS = 7


def simulator() -> None:
    """Time one frame of 1080 x 1920: its light, its noise, and the same with every effect forced."""
    spec = before_a_screen(load_head(SCENE))
    plain, everything = (World(spec, VirtualClock(), choose=partial(decide, everything=forced)) for forced in (0, 1))
    for world in (plain, everything):
        world.electrons_per_s(spec.light.colour)  # renders the object, which both runs need
    warm_ms = median_ms(plain, fresh=False)
    cold_ms, all_ms = median_ms(plain, fresh=True), median_ms(everything, fresh=True)
    (bare_ms,) = timing.side_by_side_ms(bare_ffts(plain))
    electrons = plain.electrons(spec.camera.exposure_s)
    (noise_ms,) = timing.side_by_side_ms(lambda: plain.sensor.read(electrons, (1, 1), None))
    timing.head("a simulated frame, 1080 x 1920, the object drawn", "ms", "ratio", "limit")
    timing.row("its three bare real FFTs", bare_ms, 1.0)
    timing.row("light on the sensor, caustic cached", warm_ms, warm_ms / bare_ms, limit=400, value=warm_ms)
    timing.row("its noise and counts", noise_ms, noise_ms / bare_ms)
    timing.row("light on the sensor, every effect forced", all_ms, 1.0)
    timing.row("the same with the plan", cold_ms, cold_ms / all_ms, limit=SKIPPED_LIMIT, value=cold_ms / all_ms)
    timing.row("peak MB of it", timing.peak_mb(partial(electrons_per_s, plain.setup(spec.light.colour))))


def before_a_screen(spec: InstrumentSpec) -> InstrumentSpec:
    """Return the same object on a self-luminous screen."""
    assert spec.sim is not None
    eye = spec.sim.eye.model_copy(update={"shown_by": "screen"})
    return spec.model_copy(update={"sim": spec.sim.model_copy(update={"eye": eye})})


def median_ms(world: World, *, fresh: bool) -> float:
    """Return the median time to render the sensor's light again; `fresh` also retraces the caustics."""
    times = []
    for _ in range(TURNS):
        if fresh:
            cached_psf.cache_clear()
        begin = time.perf_counter()
        electrons_per_s(world.setup(world.spec.light.colour))
        times.append(time.perf_counter() - begin)
    return float(np.median(times)) * 1e3


def bare_ffts(world: World) -> partial[None]:
    """Return the transforms of object and caustic and the inverse of their product, without any other work."""
    setup = world.setup(world.spec.light.colour)
    wide = [fft.next_fast_len(n + world.psf("green").shape[0] - 1, real=True) for n in setup.object.shape]
    image = np.ones(wide, np.float32)

    def go() -> None:
        spectrum = fft.rfft2(image, workers=2)
        fft.rfft2(image, workers=2)
        fft.irfft2(spectrum, wide, workers=2)

    return partial(go)
