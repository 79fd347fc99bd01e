"""Defects of raw counts that the simulator does not model, one function each.

Counts are uint16 (rows, cols); `white_dn` is the full-scale count, `black_dn` the count without light. Sizes are shares
of the rows, positions shares of rows or columns, so that merged pixels have the same defect.
"""

from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from device.config.head_file import CameraSpec
from device.sim.effects.illumination import pulse_light
from device.values import Counts, Image, Mask

COLUMNS_AT = (0.31, 0.44, 0.56, 0.68)  # of the width
ROWS_AT = (0.36, 0.61)  # of the height
WIDE = 3 / 1080  # of the rows: width of a group of dead columns or rows
BLOB_AT, BLOB_SHARE = (0.45, 0.56), 0.055  # 60 of 1080 rows
GLARE_AT, GLARE_SIGMA = (0.42, 0.57), 0.022
PWM_HZ = 400.0  # of dimmed LEDs
FLICKER_HZ, READ_S = 100.0, 0.032  # mains light, and a rolling shutter's time from the first row to the last


def psf_counts(psf: Image, camera: CameraSpec, peak_e: float) -> Counts:
    """Return a PSF as the camera takes it, with `peak_e` electrons in its brightest pixel."""
    rng = np.random.default_rng(47)
    arrived_e = rng.poisson(np.maximum(psf, 0) / psf.max() * peak_e)
    return _as_counts(rng.normal(arrived_e, camera.read_noise_e) / camera.gain_e_per_dn + camera.black_dn, camera)


def dead_columns(shape: tuple[int, int]) -> Mask:
    """Return the mask of twelve columns of a full sensor, in four groups of three."""
    dead = np.zeros(shape, np.bool_)
    for at in COLUMNS_AT:
        first = round(at * shape[1])
        dead[:, first : first + _wide_px(shape)] = True
    return dead


def dead_rows(shape: tuple[int, int]) -> Mask:
    """Return the mask of six rows of a full sensor, in two groups of three."""
    dead = np.zeros(shape, np.bool_)
    for at in ROWS_AT:
        first = round(at * shape[0])
        dead[first : first + _wide_px(shape)] = True
    return dead


def _wide_px(shape: tuple[int, int]) -> int:
    return max(1, round(WIDE * shape[0]))


def blob(shape: tuple[int, int], share: float = BLOB_SHARE) -> Mask:
    """Return the mask of a disc near the centre, as of a dust grain; its radius is `share` of the rows."""
    rows, cols = (np.arange(n) - at * n for n, at in zip(shape, BLOB_AT, strict=True))
    return np.asarray(np.hypot(rows[:, None], cols[None]) < share * shape[0])


def read_as(counts: Counts, where: Mask, value_dn: int) -> Counts:
    """Return the counts with `value_dn` where the mask is set."""
    out = counts.copy()
    out[where] = value_dn
    return out


def declared(where: Mask) -> Image:
    """Return a flat frame with NaN at bad pixels and 1 elsewhere, the way a user of `reconstruct` declares them."""
    return np.where(where, np.float32(np.nan), np.float32(1))


def warm(counts: Counts, camera: CameraSpec, share: float, more: float) -> Counts:
    """Raise a random `share` of the pixels by `more` times the full-scale count, and clip."""
    out = counts.astype(np.float64)
    out[np.random.default_rng(41).random(counts.shape) < share] += more * camera.white_dn
    return _as_counts(out, camera)


def glare(counts: Counts, camera: CameraSpec, share: float) -> Counts:
    """Add a Gaussian bright reflex with shot noise; it saturates about `share` of all pixels, its halo stays below."""
    rows, cols = (np.arange(n) - at * n for n, at in zip(counts.shape, GLARE_AT, strict=True))
    sigma_px = GLARE_SIGMA * counts.shape[0]
    spot = np.exp(-(rows[:, None] ** 2 + cols[None] ** 2) / (2 * sigma_px**2))
    clipped_px = share * counts.size
    span_e = camera.full_well_e
    peak_e = span_e * float(np.exp(clipped_px / np.pi / (2 * sigma_px**2)))  # the spot alone saturates these pixels
    arriving_e = np.random.default_rng(42).poisson(np.minimum(spot * peak_e, 20 * span_e))
    return _as_counts(counts + arriving_e / camera.gain_e_per_dn, camera)


def flicker(counts: Counts, camera: CameraSpec, share: float) -> Counts:
    """Multiply the light above black by 1 + `share` sin(2 pi FLICKER_HZ t), with t = 0 to READ_S over the rows."""
    swing = 1 + share * np.sin(2 * np.pi * FLICKER_HZ * READ_S * np.linspace(0, 1, counts.shape[0]))
    return _as_counts(camera.black_dn + (counts - camera.black_dn) * swing[:, None], camera)


def bands(counts: Counts, camera: CameraSpec, share: float, phase: float = 0.3) -> Counts:
    """Multiply the light above black by that of pulses of PWM_HZ, about 1 +- `share`; `phase` in periods."""
    begin_s = READ_S * np.linspace(0, 1, counts.shape[0]) + phase / PWM_HZ
    swing = pulse_light(begin_s, banded_exposure_s(share), PWM_HZ, 0.5)
    return _as_counts(camera.black_dn + (counts - camera.black_dn) * swing[:, None], camera)


def column_noise(counts: Counts, camera: CameraSpec, share: float) -> Counts:
    """Add a normal offset to each column, with a standard deviation of `share` of the mean light."""
    return _as_counts(counts + _line_noise(counts, camera, share, counts.shape[1]), camera)


def row_noise(counts: Counts, camera: CameraSpec, share: float) -> Counts:
    """Add a normal offset to each row, with a standard deviation of `share` of the mean light."""
    return _as_counts(counts + _line_noise(counts, camera, share, counts.shape[0])[:, None], camera)


def column_gain(counts: Counts, camera: CameraSpec, share: float) -> Counts:
    """Multiply the light of each column by a normal gain of 1 +- `share`."""
    gain = 1 + share * np.random.default_rng(45).standard_normal(counts.shape[1])
    return _as_counts(camera.black_dn + (counts - float(camera.black_dn)) * gain, camera)


def _line_noise(counts: Counts, camera: CameraSpec, share: float, lines: int) -> NDArray[np.float64]:
    return np.random.default_rng(44).standard_normal(lines) * share * (float(counts.mean()) - camera.black_dn)


def repeated_block(counts: Counts, share: float) -> Counts:
    """Repeat one row, at 45 % of the height, in the place of the next `share` of the rows."""
    out, first = counts.copy(), round(0.45 * len(counts))
    out[first : first + round(share * len(counts))] = counts[first - 1]
    return out


def repeated_rows(counts: Counts, share: float) -> Counts:
    """Repeat the row before in the place of `share` of the rows, spread evenly."""
    out, rows = counts.copy(), np.linspace(1, len(counts) - 1, round(share * len(counts))).astype(int)
    out[rows] = counts[rows - 1]
    return out


def lost_rows(counts: Counts, share: float) -> Counts:
    """Leave out `share` of the rows at 40 % of the height: those below move up, and the last ones become 0."""
    first, lost = round(0.4 * len(counts)), round(share * len(counts))
    return np.concatenate([counts[:first], counts[first + lost :], np.zeros_like(counts[:lost])])


def banded_exposure_s(share: float) -> float:
    """Return the exposure, half a period of PWM_HZ more than whole ones, whose bands are nearest to +- `share`."""
    return (round(0.5 / share - 0.5) + 0.5) / PWM_HZ


def reflex(counts: Counts, camera: CameraSpec) -> Counts:
    """Add a disc of 60 % of the mean light that is not clipped: a reflex that did not pass the diffuser."""
    rows, cols = (np.arange(n) - at * n for n, at in zip(counts.shape, GLARE_AT, strict=True))
    disc = rows[:, None] ** 2 + cols**2 < (0.055 * counts.shape[0]) ** 2
    return _as_counts(counts + 0.6 * (counts.mean() - camera.black_dn) * disc, camera)


def vignetting(counts: Counts, camera: CameraSpec, share: float) -> Counts:
    """Multiply the light above black by 1 - `share` r^2, with r from 0 at the middle to 1 at the corners."""
    rows, cols = (np.arange(n) - (n - 1) / 2 for n in counts.shape)
    squared = rows[:, None] ** 2 + cols**2
    return _as_counts(camera.black_dn + (counts - camera.black_dn) * (1 - share * squared / squared.max()), camera)


def leak(counts: Counts, camera: CameraSpec, share: float) -> Counts:
    """Add `share` of the mean light in the bottom right corner, which falls off with a tenth of the sensor's width."""
    rows, cols = (np.arange(n)[::-1] / counts.shape[1] for n in counts.shape)
    added = share * np.exp(-np.hypot(rows[:, None], cols) / 0.1)
    return _as_counts(counts + added * (counts.mean() - camera.black_dn), camera)


def offset(counts: Counts, camera: CameraSpec, more_dn: float) -> Counts:
    """Raise all counts by `more_dn`, so that the black level differs from the head file; round and clip."""
    return _as_counts(counts + more_dn, camera)


def eight_bits(counts: Counts, camera: CameraSpec) -> NDArray[np.uint8]:
    """Return the upper eight bits of the counts of the head's converter."""
    return np.asarray(counts >> (camera.bit_depth - 8), np.uint8)


def gamma(counts: Counts, camera: CameraSpec) -> NDArray[np.uint8]:
    """Return the light above black as a picture of 8 bits has it, with a gamma of 2.2."""
    light = np.clip((counts.astype(np.float64) - camera.black_dn) / (camera.white_dn - camera.black_dn), 0, 1)
    return np.rint(255 * light ** (1 / 2.2)).astype(np.uint8)


def jpeg(counts: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return counts of 8 bits after a compression as JPEG of quality 90."""
    file = BytesIO()
    Pillow.fromarray(counts).save(file, "JPEG", quality=90)
    return np.asarray(Pillow.open(file))


def missing(counts: Counts, share: float) -> Image:
    """Return the counts as float, with NaN in a random `share` of the pixels."""
    out = counts.astype(np.float32)
    out[np.random.default_rng(43).random(counts.shape) < share] = np.nan
    return out


def _as_counts(values: NDArray[Any], camera: CameraSpec) -> Counts:
    return np.clip(np.round(values), 0, camera.white_dn).astype(np.uint16)
