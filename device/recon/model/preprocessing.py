"""Preprocessing: counts to linear DN in one pass (dark, nonlinearity, flat, bad and saturated pixels, binning)."""

from dataclasses import dataclass

import numpy as np

from device.errors import FrameError
from device.recon.model import kernels
from device.recon.model.compiled import read_only
from device.recon.model.grid import Grid
from device.recon.model.kernels import Pixels, Places
from device.values import Calibration, Image

MIN_GOOD = 0.5  # share of a sample's pixels that hold light; with fewer it is a gap
MAX_BAD = 0.3  # share of pixels that may be missing (NUMERICS.md 6.1: at 30 % a masked fit still finds 0.89 of 0.95)


@dataclass(frozen=True)
class Linear:
    """Frame in linear DN above dark on a grid's window.

    Attributes
    ----------
    y
        Light in DN, float32 (rows, cols).
    good
        Good share of each sample, float32 (rows, cols), 0 to 1.
    mean_dn
        Mean over good pixels.
    saturated
        Share of saturated pixels.
    missing
        Share of missing pixels.
    """

    y: Image
    good: Image
    mean_dn: float
    saturated: float
    missing: float

    @property
    def has_gaps(self) -> bool:
        """True if a sample has lost more than half of its pixels; other samples use the mean of the remaining ones."""
        return self.missing > 0 and bool(self.good.min() < MIN_GOOD)


class Preprocessor:
    """Preprocessing of the frames of one sensor, with the buffers of one grid's window.

    It holds dark level, nonlinearity, flat frame and bad pixels.

    Parameters
    ----------
    calibration
        Calibration of the head.
    grid
        Grid of the model.
    output_buffer
        Buffer of the linear frame, float32 of the window's shape; None: its own.

    Raises
    ------
    FrameError
        More than MAX_BAD of the pixels are marked bad, the sensor is smaller than one sample, or a frame of
        the calibration has another shape than the sensor.
    """

    def __init__(self, calibration: Calibration, grid: Grid, output_buffer: Image | None = None) -> None:
        self.grid = grid
        shape = grid.sensor
        self.white = calibration.sensor.white_dn
        self.bend_per_dn = calibration.sensor.bend_per_dn
        self.dark = np.full((1, shape[1]), calibration.sensor.black_dn, np.float32)  # one row for all rows
        self.gain = np.ones((1, shape[1]), np.float32)
        if calibration.dark_dn is not None:
            self.dark = require_shape("dark frame", calibration.dark_dn, shape).astype(np.float32)
        if calibration.flat is not None or calibration.bad is not None or len(self.dark) > 1:
            self.gain = np.ones(shape, np.float32)
        if calibration.flat is not None:
            flat = require_shape("flat frame", calibration.flat, shape)
            usable = np.isfinite(flat) & (flat > 0)
            mean = float(flat[usable].mean(dtype=np.float64)) if usable.any() else 1.0
            self.gain[:] = np.where(usable, mean / np.where(usable, flat, 1), 0)
        if len(self.dark) > 1:
            self.gain[~np.isfinite(self.dark)] = 0
            self.dark[~np.isfinite(self.dark)] = 0
        if calibration.bad is not None:
            self.gain[require_shape("bad-pixel mask", calibration.bad, shape)] = 0
        self.dark = read_only(self.dark)
        missing = float((self.gain == 0).mean())
        if missing > MAX_BAD:
            raise FrameError(
                f"{missing:.0%} of the sensor's pixels are marked bad",
                "Calibrate the head again; the sensor may be broken.",
            )
        if min(grid.window) < 1:
            raise FrameError(f"a frame of {shape[0]} x {shape[1]} pixels is too small to bin by {grid.n}")
        y = np.empty(grid.window, np.float32) if output_buffer is None else output_buffer
        self._out = Linear(y, np.empty(grid.window, np.float32), 0.0, 0.0, 0.0)

    def __call__(self, counts: Pixels, dark: Pixels | None = None, defects: Places | None = None) -> Linear:
        """Return one frame in linear DN on the window of the grid.

        Saturated and bad pixels, NaN and `defects` count as missing. The next call overwrites the buffers of
        the result.

        Parameters
        ----------
        counts
            Counts, uint16 or float32 (rows, cols).
        dark
            Dark frame of the same shape; None: that of the calibration.
        defects
            Flat indices of defective pixels; None: none.

        Returns
        -------
        Linear
            Light and good share of each sample.

        Raises
        ------
        FrameError
            The frame has another shape, or more than MAX_BAD of its pixels are missing.
        """
        counts = require_shape("frame", counts, self.grid.sensor)
        offset = self.dark if dark is None else require_shape("dark frame", dark, self.grid.sensor)
        y = self._out.y
        good = self._out.good
        grid = self.grid
        first = grid.first_px
        n = grid.n
        saturated, good_count, light_dn = kernels.linearise(
            counts, offset, self.bend_per_dn, self.gain, self.white, first, n, y, good
        )
        if defects is not None:
            lost_count, lost_dn = kernels.exclude_pixels(
                counts, offset, self.bend_per_dn, self.gain, self.white, first, n, defects, y, good
            )
            good_count = good_count - lost_count
            light_dn = light_dn - lost_dn
        mean_good = good_count / (good.size * n**2)
        if mean_good < 1 - MAX_BAD:
            raise FrameError(
                f"{1 - mean_good:.0%} of the frame cannot be used (saturated, bad or not numbers)",
                "Too bright. Move back a little, or lower the exposure; then take it again.",
            )
        return Linear(y, good, light_dn / max(good_count, 1), saturated / (good.size * n**2), 1 - mean_good)


def require_shape(name: str, array: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the array, read-only; FrameError with `name` for another shape, as compiled code checks no bounds."""
    if array.shape != shape:
        raise FrameError(
            f"the {name} has {' x '.join(map(str, array.shape))} pixels, this head {shape[0]} x {shape[1]}",
            "Use files of one and the same camera mode.",
        )
    return read_only(array)
