"""Time from the raw camera buffer to a linear frame, relative to one copy of its bytes, and its memory growth."""

import tracemalloc

import numpy as np

from device.drivers.raw_counts import pi_layout
from device.recon.model.grid import Grid
from device.recon.model.preprocessing import Preprocessor
from device.values import Calibration, Psf, Sensor
from tests.bench import timing
from tests.scenes import speckle

SHAPE, BITS, STRIDE = (1088, 1456), 10, 2944  # rows of an IMX296 with the padding of a Raspberry Pi
LIMIT_MS, FRAMES = 6.0, 1000


def camera() -> None:
    """Time unpacking, black level, dark frame, flat field and bad pixels: all preprocessing before reconstruction."""
    rng = np.random.default_rng(0)
    sensor = Sensor(black_dn=60, white_dn=1023)
    flat = rng.uniform(0.9, 1.1, SHAPE).astype(np.float32)
    calibration = Calibration((Psf(speckle((64, 64))),), sensor, flat=flat)
    prepare = Preprocessor(calibration, Grid.periodic(SHAPE, 1, float("inf")))
    counts, dark = np.empty(SHAPE, np.uint16), rng.integers(58, 63, SHAPE, dtype=np.uint16)
    timing.head("a raw buffer to linear float32, 1456 x 1088", "ms", "copies", "limit")
    for name in ("R10", "R16"):
        layout = pi_layout(name, *SHAPE, BITS)
        raw = rng.integers(60, 1000, (SHAPE[0], STRIDE // 2), dtype=np.uint16) << layout.shift
        buffer, there = raw.view(np.uint8), np.empty(raw.nbytes, np.uint8)

        def act(layout=layout, buffer=buffer) -> None:
            prepare(layout.counts(buffer, counts), dark)

        copy_ms, ms = timing.side_by_side_ms(lambda b=buffer, t=there: np.copyto(t, b.reshape(-1)), act)
        timing.row(f"{name}, with dark frame and flat field", ms, ms / copy_ms, limit=LIMIT_MS, value=ms)
    timing.row(f"growth over {FRAMES} frames, kB", growth_kb(act), limit=16.0, value=growth_kb(act))


def growth_kb(act) -> float:
    """Return the growth of the memory held by Python's allocators between a few frames and many."""
    tracemalloc.start()
    for _ in range(10):
        act()
    before = tracemalloc.get_traced_memory()[0]
    for _ in range(FRAMES):
        act()
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    return (after - before) / 1024
