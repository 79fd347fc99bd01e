"""Counts to linear: black level, dark frame, flat frame, bad and saturated pixels, binning - in one pass."""

from dataclasses import dataclass

import numpy as np

from device.errors import FrameError
from device.recon import kernels
from device.recon.geometry import Grid
from device.recon.kernels import Pixels
from device.values import Calibration, Image

MOST_BAD = 0.3  # share of pixels that may be missing (optics.md 5.4: at 30 % a masked fit still finds 0.89 of 0.95)


@dataclass(frozen=True)
class Linear:
    """A frame in linear DN above dark on a grid's window, (rows, cols), and the good share of each sample, 0 to 1."""

    y: Image
    good: Image
    saturated: float
    missing: float


class Preparer:
    """Knows one sensor: its dark level, its response, its bad pixels; owns the buffers of one grid's window."""

    def __init__(self, calibration: Calibration, grid: Grid) -> None:
        self.grid, shape = grid, grid.sensor
        self.white = calibration.sensor.white_dn
        self.dark = np.full(shape, calibration.sensor.black_dn, np.float32)
        if calibration.dark_dn is not None:
            self.dark[:] = _fitting("dark frame", calibration.dark_dn, shape)
        self.gain = np.ones(shape, np.float32)
        if calibration.flat is not None:
            flat = _fitting("flat frame", calibration.flat, shape)
            usable = np.isfinite(flat) & (flat > 0)
            mean = float(flat[usable].mean(dtype=np.float64)) if usable.any() else 1.0
            self.gain[:] = np.where(usable, mean / np.where(usable, flat, 1), 0)
        self.gain[~np.isfinite(self.dark)] = 0
        self.dark[~np.isfinite(self.dark)] = 0
        if calibration.bad is not None:
            self.gain[_fitting("bad-pixel mask", calibration.bad, shape)] = 0
        missing = float((self.gain == 0).mean())
        if missing > MOST_BAD:
            raise FrameError(
                f"{missing:.0%} of the sensor's pixels are marked bad",
                "Calibrate the head again; the sensor may be broken.",
            )
        if min(grid.window) < 1:
            raise FrameError(f"a frame of {shape[0]} x {shape[1]} pixels is too small to bin by {grid.n}")
        self._out = Linear(np.empty(grid.window, np.float32), np.empty(grid.window, np.float32), 0.0, 0.0)

    def __call__(self, counts: Pixels, dark: Pixels | None = None) -> Linear:
        """Linear DN of one frame (rows, cols), uint16 or float32; `dark` is this shot's own dark frame.

        NaN counts as missing. The result lives in buffers that the next call overwrites.
        """
        _fitting("frame", counts, self.grid.sensor)
        offset = self.dark if dark is None else _fitting("dark frame", dark, self.grid.sensor)
        y, good, grid = self._out.y, self._out.good, self.grid
        saturated, believed = kernels.linearise(counts, offset, self.gain, self.white, grid.first_px, grid.n, y, good)
        mean_good = believed / (good.size * grid.n**2)
        if mean_good < 1 - MOST_BAD:
            raise FrameError(
                f"{1 - mean_good:.0%} of the frame cannot be used (saturated, bad or not numbers)",
                "Too bright. Move back a little, or lower the exposure; then take it again.",
            )
        return Linear(y, good, saturated / (good.size * grid.n**2), 1 - mean_good)


def _fitting(name: str, array: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    if array.shape != shape:
        raise FrameError(
            f"the {name} has {' x '.join(map(str, array.shape))} pixels, this head {shape[0]} x {shape[1]}",
            "Use files of one and the same camera mode.",
        )
    return array
