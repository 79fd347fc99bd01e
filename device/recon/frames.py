"""Checks and small changes of frames and calibrations, which every reconstructor needs."""

from dataclasses import replace

import numpy as np

from device.errors import FrameError
from device.recon.model.compiled import read_only
from device.recon.model.kernels import Pixels
from device.values import Calibration, check_image_shape


def checked(counts: Pixels, shape: tuple[int, int]) -> Pixels:
    """Return the counts, (rows, cols) or (rows, cols, 3); FrameError for other rows and columns than `shape`."""
    check_image_shape(counts.shape)
    if counts.shape[:2] != shape:
        raise FrameError(f"the frame has {counts.shape[:2]} pixels, the calibration {shape}", "Use the head's own PSF.")
    return counts


def noise_frame(calibration: Calibration, shape: tuple[int, int]) -> Pixels:
    """Return noise of `shape` below the white level: 100 to 200 DN, or less, as float32, for a level of 200 or less."""
    noise = np.random.default_rng(0).integers(100, 200, shape, dtype=np.uint16)
    white_dn = calibration.sensor.white_dn
    return noise if white_dn > 200 else noise * np.float32(white_dn / 256)


def without_sensor(calibration: Calibration) -> Calibration:
    """Return the calibration for linear frames above dark: no level, no bend, no dark and flat frame, no bad pixels."""
    sensor = replace(calibration.sensor, black_dn=0.0, white_dn=float("inf"), bend_per_dn=0.0)
    return replace(calibration, sensor=sensor, dark_dn=None, flat=None, bad=None)


def plane(image: Pixels, c: int) -> Pixels:
    """Return channel `c` of (rows, cols, 3), or a whole (rows, cols) image, as a contiguous read-only array.

    uint16 is kept, any other type becomes float32; the caller's array stays writeable.
    """
    image = image if image.ndim == 2 else image[..., c]
    if image.dtype == np.uint16:
        return read_only(np.ascontiguousarray(image, np.uint16))
    return read_only(np.ascontiguousarray(image, np.float32))
