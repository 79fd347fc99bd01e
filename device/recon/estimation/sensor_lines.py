"""Faults of the rows and columns of a sensor in one frame: rows out of order, noise of rows and columns, a gain step.

All are measured in one pass over the counts. NUMERICS.md 6.3 to 6.5.
"""

from typing import NamedTuple

import numpy as np

from device.recon.estimation.gain_step import find_gain_step
from device.recon.estimation.line_noise import BANDS, LineNoise, line_noise
from device.recon.estimation.row_order import MAX_REPEATED, MIN_LIGHT, MIN_SPREAD, SEGMENTS, RowOrder
from device.recon.model import kernels
from device.recon.model.compiled import read_only
from device.recon.model.kernels import Pixels
from device.values import Image, Psf

BINS = 100  # across the sensor
LINE_NOISES = ("column_noise_dn", "row_noise_dn")  # in a report
SAME = 0.999  # likeness of two equal rows, with the rounding of single precision


class Lines(NamedTuple):
    """Sums of a frame that hold what its rows and columns have in common.

    Attributes
    ----------
    bands
        Means of BANDS groups of rows in DN, (BANDS, cols); of fewer rows than that, each is a group.
    bins
        Means of neighbouring pixels of each row in DN, (rows, about BINS).
    likeness
        Correlation of the fine texture of each row, from the second on, with that of the row before, median over the
        segments of a row, (rows - 1,).
    unknown
        Number of the values of each row that are not numbers, (rows,).
    """

    bands: Image
    bins: Image
    likeness: Image
    unknown: Image


def lines_of(counts: Pixels) -> Lines:
    """Return the sums of a frame (rows, cols), uint16 or float32 of any unit."""
    rows, cols = counts.shape
    groups = min(BANDS, rows)
    width = max(1, cols // BINS)
    bands, bins = np.zeros((groups, cols), np.float32), np.zeros((rows, cols // width), np.float32)
    texture, unknown = np.zeros((rows, SEGMENTS, 2), np.float32), np.zeros(rows, np.float32)
    kernels.line_sums(_contiguous(counts), width, bands, bins, texture, unknown)
    members = np.bincount(np.arange(rows) * groups // rows).astype(np.float32)
    own = np.sqrt(texture[1:, :, 0]) * np.sqrt(texture[:-1, :, 0])
    likeness = np.asarray(np.divide(texture[1:, :, 1], own, out=np.zeros_like(own), where=own > 0), np.float32)
    bands, bins = np.asarray(bands / members[:, None], np.float32), np.asarray(bins / np.float32(width), np.float32)
    return Lines(bands, bins, np.asarray(np.median(likeness, axis=1), np.float32), unknown)


def _contiguous(counts: Pixels) -> Pixels:
    if counts.dtype == np.uint16:
        return read_only(np.ascontiguousarray(counts, np.uint16))
    return read_only(np.ascontiguousarray(counts, np.float32))


class EvenFrame(NamedTuple):
    """Counts without the faults of rows and columns, the sizes of what was taken out by names in a report (rms of noise
    in DN, share of a gain step), and notes for the report.
    """

    counts: Pixels
    figures: dict[str, float]
    notes: tuple[str, ...] = ()


class LineFinder:
    """Search for faults of rows and columns in frames with this dark frame, white level and PSF.

    `dark`: (rows, cols) or (1, cols), float32 DN.
    """

    def __init__(self, dark: Image, white_dn: float, psf: Psf) -> None:
        self._dark, self._white_dn = dark, white_dn
        self._dark_lines = lines_of(dark)
        seen = lines_of(psf.pixels)
        self._order = RowOrder(seen.bins)
        light = seen.bands.mean(axis=0)
        spread = float((light > MIN_LIGHT * light.max()).mean())
        self._blurs = spread >= MIN_SPREAD and find_gain_step(seen.bands) is None

    def __call__(self, counts: Pixels, dark: Pixels | None = None) -> EvenFrame:
        """Return a frame, (rows, cols) or (rows, cols, 3), without noise of rows and columns and a gain step, if any.

        Parameters
        ----------
        counts
            Counts, uint16 or float32.
        dark
            Dark frame of this shot, of the same shape; None: that of the calibration.

        Returns
        -------
        EvenFrame
            The same counts without such a fault, else float32; saturated pixels keep their counts.

        Raises
        ------
        FrameError
            Rows are repeated or missing.
        """
        if counts.ndim == 2:
            return self._even(counts, dark)
        darks = [None if dark is None else dark[..., c] for c in range(counts.shape[2])]
        channels = [self._even(counts[..., c], channel_dark) for c, channel_dark in enumerate(darks)]
        if not any(channel.figures for channel in channels):
            return EvenFrame(counts, {})
        names = {name for channel in channels for name in channel.figures}
        figures = {name: max(channel.figures.get(name, 0.0) for channel in channels) for name in sorted(names)}
        notes = max((channel.notes for channel in channels), key=len)
        even = np.stack([np.asarray(channel.counts, np.float32) for channel in channels], -1)
        return EvenFrame(even, figures, notes)

    def _even(self, counts: Pixels, dark: Pixels | None) -> EvenFrame:
        offset = self._dark if dark is None else np.asarray(dark, np.float32)
        dark_lines = self._dark_lines if dark is None else lines_of(dark)
        lines = lines_of(counts)
        if not lines.likeness.size or (lines.likeness > SAME).mean() > MAX_REPEATED:  # one row, or a scaled file
            return EvenFrame(counts, {})
        light = lines.bands - dark_lines.bands
        columns, rows = line_noise(light), line_noise(_row_bands(lines.bins - dark_lines.bins))
        noises = zip(LINE_NOISES, (columns, rows), strict=True)
        figures = {name: noise.rms_dn for name, noise in noises if noise is not None}
        notes: tuple[str, ...] = ()
        step = find_gain_step(light) if self._blurs and columns is None else None
        if step is not None:
            columns, figures["gain_step"], notes = step.as_noise(counts.shape[1]), abs(step.share), (step.words,)
        even = EvenFrame(counts, {})
        if figures:
            even = EvenFrame(self._without(counts, offset, columns, rows), figures, notes)
            lines = lines_of(even.counts)  # noise of columns makes rows alike
        self._order(even.counts, lines.bins - dark_lines.bins, lines.likeness, lines.unknown)
        return even

    def _without(self, counts: Pixels, offset: Image, columns: LineNoise | None, rows: LineNoise | None) -> Image:
        """Return the counts without offset and gain of columns and rows."""
        light = np.asarray(counts - offset, np.float32)
        for axis, noise in enumerate((columns, rows)):
            if noise is not None:
                offset_dn, gain = (np.expand_dims(part, axis) for part in (noise.offset_dn, noise.gain))
                light = (light - offset_dn) / gain
        below = np.nextafter(np.float32(self._white_dn), np.float32(0))
        even = np.where(counts >= self._white_dn, np.float32(self._white_dn), np.minimum(light + offset, below))
        return np.asarray(even, np.float32)


def _row_bands(bins: Image) -> Image:
    """Return the means of BANDS groups of columns, (BANDS, rows)."""
    groups = [group.mean(axis=1) for group in np.array_split(bins, BANDS, axis=1) if group.size]
    return np.asarray(groups, np.float32)
