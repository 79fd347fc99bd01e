"""Defects that the simulator does not have, put into the raw counts: one function each.

Counts are uint16 (rows, cols); `white_dn` is the full-scale count, `black_dn` the count without light. Sizes are shares
of the rows, positions shares of rows or columns, so that merged pixels have the same defect.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from device.spec import CameraSpec
from device.values import Counts, Image, Mask

COLUMNS_AT = (0.31, 0.44, 0.56, 0.68)  # of the width
ROWS_AT = (0.36, 0.61)  # of the height
WIDE = 3 / 1080  # of the rows: how wide a group of dead columns or rows is
BLOB_AT, BLOB_SHARE = (0.45, 0.56), 0.055  # 60 of 1080 rows
GLARE_AT, GLARE_SIGMA = (0.42, 0.57), 0.022
FLICKER_HZ, READ_S = 100.0, 0.032  # mains light, and a rolling shutter's time from the first row to the last


def dead_columns(shape: tuple[int, int]) -> Mask:
    """Twelve columns of a full sensor in four groups of three."""
    dead = np.zeros(shape, np.bool_)
    for at in COLUMNS_AT:
        first = round(at * shape[1])
        dead[:, first : first + _wide_px(shape)] = True
    return dead


def dead_rows(shape: tuple[int, int]) -> Mask:
    """Six rows of a full sensor in two groups of three."""
    dead = np.zeros(shape, np.bool_)
    for at in ROWS_AT:
        first = round(at * shape[0])
        dead[first : first + _wide_px(shape)] = True
    return dead


def _wide_px(shape: tuple[int, int]) -> int:
    return max(1, round(WIDE * shape[0]))


def blob(shape: tuple[int, int], share: float = BLOB_SHARE) -> Mask:
    """A disc near the middle, as a grain of dust on the sensor makes it; its radius is a `share` of the rows."""
    rows, cols = (np.arange(n) - at * n for n, at in zip(shape, BLOB_AT, strict=True))
    return np.asarray(np.hypot(rows[:, None], cols[None]) < share * shape[0])


def read_as(counts: Counts, where: Mask, value_dn: int) -> Counts:
    """The counts with one value where the mask says."""
    out = counts.copy()
    out[where] = value_dn
    return out


def declared(where: Mask) -> Image:
    """A flat frame that holds no number where a pixel is bad: how a user of `reconstruct` declares it."""
    return np.where(where, np.float32(np.nan), np.float32(1))


def warm(counts: Counts, camera: CameraSpec, share: float, more: float) -> Counts:
    """A share of the pixels, drawn at random, reads higher by `more` of the converter's span."""
    out = counts.astype(np.float64)
    out[np.random.default_rng(41).random(counts.shape) < share] += more * camera.white_dn
    return _as_counts(out, camera)


def glare(counts: Counts, camera: CameraSpec, share: float) -> Counts:
    """A smooth bright reflex with its own shot noise, clipped in `share` of all pixels; its halo is not clipped."""
    rows, cols = (np.arange(n) - at * n for n, at in zip(counts.shape, GLARE_AT, strict=True))
    sigma_px = GLARE_SIGMA * counts.shape[0]
    spot = np.exp(-(rows[:, None] ** 2 + cols[None] ** 2) / (2 * sigma_px**2))
    clipped_px = share * counts.size
    span_e = camera.full_well_e
    peak_e = span_e * float(np.exp(clipped_px / np.pi / (2 * sigma_px**2)))  # the spot alone fills the well there
    arriving_e = np.random.default_rng(42).poisson(np.minimum(spot * peak_e, 20 * span_e))
    return _as_counts(counts + arriving_e / camera.gain_e_per_dn, camera)


def flicker(counts: Counts, camera: CameraSpec, share: float) -> Counts:
    """Multiply the light above black by 1 + `share` sin(2 pi FLICKER_HZ t), with t = 0 to READ_S over the rows."""
    swing = 1 + share * np.sin(2 * np.pi * FLICKER_HZ * READ_S * np.linspace(0, 1, counts.shape[0]))
    return _as_counts(camera.black_dn + (counts - camera.black_dn) * swing[:, None], camera)


def offset(counts: Counts, camera: CameraSpec, more_dn: float) -> Counts:
    """All counts higher: the black level is not the one in the head file."""
    return _as_counts(counts + more_dn, camera)


def eight_bits(counts: Counts, camera: CameraSpec) -> NDArray[np.uint8]:
    """The upper eight bits of the converter."""
    return np.asarray(counts >> (camera.bit_depth - 8), np.uint8)


def missing(counts: Counts, share: float) -> Image:
    """Counts as float, not a number in a share of the pixels drawn at random."""
    out = counts.astype(np.float32)
    out[np.random.default_rng(43).random(counts.shape) < share] = np.nan
    return out


def _as_counts(values: NDArray[Any], camera: CameraSpec) -> Counts:
    return np.clip(np.round(values), 0, camera.white_dn).astype(np.uint16)
