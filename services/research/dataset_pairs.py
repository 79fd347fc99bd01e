"""Pairs of raw frame, PSF and truth of a lensless data set, read one at a time with the facts of its layout applied.

Every frame that is read is upright, its channels are red, green and blue, and its truth is on its own pixels.
`datasets.open_dataset` recognises the layout of a folder.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from device.config.image_files import Raw, as_psf, as_raw, read_counts, read_image
from device.config.marked_files import is_marked_simulated
from device.errors import FrameError, PsfError
from device.recon.estimation.defective_pixels import without_hot_pixels
from device.values import Image, Psf, SimulatedCounts

Stored = Literal["upright", "upside down", "rotated by 180 degrees"]
Pixels = NDArray[Any]


@dataclass(frozen=True)
class Region:
    """Rows `top` to `bottom` and columns `left` to `right` of an upright frame; the ends are exclusive."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the region in an array of (rows, cols)."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the region."""
        return self.bottom - self.top, self.right - self.left

    def __str__(self) -> str:
        return f"rows {self.top} to {self.bottom - 1}, columns {self.left} to {self.right - 1}"


@dataclass(frozen=True)
class Layout:
    """Published facts of a data set, which `Dataset.read` applies.

    `frames` and `truths`: orientation as stored, of raw frames with their PSFs, and of truths. `bgr`: the stored
    channels are blue, green, red. `region`: the part of an upright frame of `region_of` (rows, cols) which its authors
    compare with the truth. `placement`: the part of the frame which the whole truth shows; the truth is resampled to
    it. `aligned`: the truth is on the pixels of the frame; if not, one common shift registers the pictures of a pair.
    """

    name: str
    title: str
    frames: Stored = "upright"
    truths: Stored = "upright"
    bgr: bool = False
    region: Region | None = None
    region_of: tuple[int, int] | None = None
    placement: Region | None = None
    aligned: bool = False
    citation: str = ""
    licence: str = ""

    def applied(self, with_truth: bool) -> tuple[str, ...]:
        """Return one phrase for each fact that reading applies; `with_truth`: there are truths to compare with."""
        phrases = []
        if self.frames == self.truths != "upright":
            phrases.append(f"all files are stored {self.frames}: turned upright")
        elif self.frames != "upright":
            phrases.append(f"raw frames and PSFs are stored {self.frames}: turned upright")
        if self.bgr:
            phrases.append("channels are stored as blue, green, red: read as red, green, blue")
        if self.region is not None and self.region_of is not None:
            rows, cols = self.region_of
            phrases.append(f"compared, as by its authors, in {self.region} of {rows} x {cols} (upright)")
        if self.placement is not None:
            phrases.append(f"the truth is resampled to {self.placement} of the frame (upright)")
        if with_truth and not self.aligned:
            phrases.append("one common shift registers the pictures of a pair with its truth")
        return tuple(phrases)


@dataclass(frozen=True)
class Entry:
    """Files of one pair; `psfs` are one PSF or a stack over depth, `truth` is None if there is none."""

    name: str
    raw: Path
    psfs: tuple[Path, ...]
    truth: Path | None


@dataclass(frozen=True)
class Pair:
    """One recording as it is reconstructed: upright, channels red, green, blue.

    Attributes
    ----------
    name
        Name of the recording.
    raw
        Counts, (rows, cols) or (rows, cols, 3).
    psfs
        One PSF, or one per depth, of the same rows and columns.
    truth
        Float32 (rows, cols) or (rows, cols, 3) in arbitrary linear units, NaN where nothing is known or
        compared; None if there is no truth.
    simulated
        True for a frame of the simulator.
    """

    name: str
    raw: Raw
    psfs: tuple[Psf, ...]
    truth: Image | None
    simulated: bool

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the frame."""
        return self.raw.pixels.shape[0], self.raw.pixels.shape[1]


@dataclass(frozen=True)
class Dataset:
    """Pairs of one folder, in natural order of their names.

    Iteration reads one pair at a time.

    Attributes
    ----------
    folder
        Folder of the data set.
    layout
        How the files of such a data set are stored.
    entries
        Files of each pair.
    notes
        Sentences about files that are missing or left out.
    """

    folder: Path
    layout: Layout
    entries: tuple[Entry, ...]
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[Pair]:
        """Yield every pair; FrameError or PsfError at the first file that is no valid image."""
        return map(self.read, self.entries)

    def read(self, entry: Entry) -> Pair:
        """Return one pair with the facts of the layout applied.

        Parameters
        ----------
        entry
            Files of the pair, one of `entries`.

        Returns
        -------
        Pair
            Frame, PSFs and truth, upright, (rows, cols) or (rows, cols, 3).

        Raises
        ------
        FrameError
            The frame or its truth is missing or damaged, or its size does not fit.
        PsfError
            A PSF is missing or damaged, or its size does not fit.
        """
        raw = as_raw(_upright(read_counts(entry.raw), self.layout.frames, self.layout.bgr))
        shape = (raw.pixels.shape[0], raw.pixels.shape[1])
        psfs = _read_psfs(entry.psfs, self.layout.frames, self.layout.bgr, shape)
        truth = None if entry.truth is None else _read_truth(entry.truth, self.layout, shape)
        simulated = is_marked_simulated(entry.raw)
        if simulated:  # the counts alone carry the mark, too
            raw = replace(raw, pixels=raw.pixels.view(SimulatedCounts))
        return Pair(entry.name, raw, psfs, truth, simulated)


def _upright(array: Pixels, stored: Stored, bgr: bool) -> Pixels:
    """Return an array (rows, cols[, 3]) turned upright, with its channels in the order red, green, blue."""
    if stored != "upright":
        array = array[::-1]
    if stored == "rotated by 180 degrees":
        array = array[:, ::-1]
    if bgr and array.ndim == 3:
        array = array[..., ::-1]
    return np.ascontiguousarray(array)


def _upright_psf(array: Pixels, stored: Stored, bgr: bool) -> Pixels:
    """Return a PSF turned upright around its centre at (rows//2, cols//2), which a plain flip moves for even sizes."""
    turned = _upright(array, stored, bgr)
    if stored != "upright":
        turned = np.roll(turned, 1 - array.shape[0] % 2, axis=0)
    if stored == "rotated by 180 degrees":
        turned = np.roll(turned, 1 - array.shape[1] % 2, axis=1)
    return turned


@lru_cache(maxsize=2)
def _read_psfs(files: tuple[Path, ...], stored: Stored, bgr: bool, shape: tuple[int, int]) -> tuple[Psf, ...]:
    """Return the PSFs of the files on the pixels of a frame of `shape`; the pairs of a data set share them."""
    return tuple(
        without_hot_pixels(as_psf(_upright_psf(_on_grid(array, shape, name), stored, bgr), name))
        for path in files
        for name, array in _psf_arrays(path)
    )


def _psf_arrays(path: Path) -> list[tuple[str, Pixels]]:
    """Return the name and the array of each PSF in a file: an image has one, a MATLAB file one per depth."""
    if path.suffix.lower() == ".mat":
        stack = _read_matlab(path)
        return [(f"{path.name}, depth {k}", stack[..., k]) for k in range(stack.shape[2])]
    try:
        return [(path.name, read_counts(path))]
    except FrameError as error:
        raise PsfError(error.message, error.remedy) from error


def _read_matlab(path: Path) -> Pixels:
    """Return the largest array of a MATLAB file, (rows, cols, depths); PsfError if there is none."""
    from scipy.io import loadmat  # a tenth of a second, which only this format needs

    remedy = "Give the MATLAB file that was published, or one image per depth."
    try:
        arrays = [value for value in loadmat(path).values() if isinstance(value, np.ndarray) and value.ndim == 3]
    except (OSError, ValueError, TypeError, NotImplementedError) as error:
        raise PsfError(f"{path} is not a readable MATLAB file: {error}", remedy) from error
    if not arrays:
        raise PsfError(f"{path} holds no stack of PSFs (rows, columns, depths)", remedy)
    return max(arrays, key=lambda array: array.size)


def _on_grid(array: Pixels, shape: tuple[int, int], name: str) -> Pixels:
    """Return a PSF on the pixels of a frame: unchanged, or the mean of n x n if it is n times as large."""
    factor = psf_factor((array.shape[0], array.shape[1]), shape)
    if factor is None:
        raise PsfError(
            f"{name} has {array.shape[0]} x {array.shape[1]} pixels, the raw {shape[0]} x {shape[1]}",
            "Give a PSF with the raw's rows and columns, or with n times as many of each.",
        )
    if factor == 1:
        return array
    blocks = array.reshape(shape[0], factor, shape[1], factor, *array.shape[2:])
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


def psf_factor(psf: tuple[int, int], shape: tuple[int, int]) -> int | None:
    """Return n if a PSF of `psf` (rows, cols) is n times as large as a frame of `shape`, None if it does not fit."""
    factor = psf[0] // shape[0]
    return factor if factor >= 1 and psf == (factor * shape[0], factor * shape[1]) else None


def _read_truth(path: Path, layout: Layout, shape: tuple[int, int]) -> Image:
    """Return the truth on a frame of `shape`, NaN outside the compared region of the layout."""
    truth = _upright(read_image(path), layout.truths, layout.bgr).astype(np.float32)
    if layout.placement is not None:
        return _placed(truth, layout.placement, shape, path)
    if truth.shape[:2] != shape:
        raise FrameError(
            f"{path} has {truth.shape[0]} x {truth.shape[1]} pixels, the raw {shape[0]} x {shape[1]}, and its layout "
            "states no place of the truth in the frame",
            "Give truths on the raw's own pixels: see the page on data sets.",
        )
    if layout.region is None or layout.region_of != shape:
        return truth
    return _cut(truth, layout.region, shape)


def _cut(truth: Image, region: Region, shape: tuple[int, int]) -> Image:
    kept = np.full((*shape, *truth.shape[2:]), np.nan, np.float32)
    kept[region.slices] = truth[region.slices]
    return kept


def _placed(truth: Image, region: Region, shape: tuple[int, int], path: Path) -> Image:
    """Return a truth of any size resampled to a region of the frame, NaN around it."""
    rows, cols = region.shape
    if region.bottom > shape[0] or region.right > shape[1]:
        raise FrameError(
            f"{path} belongs in {region} of the frame, which has {shape[0]} x {shape[1]} pixels",
            "Give the frames in their published size.",
        )
    planes = [
        np.asarray(Pillow.fromarray(plane).resize((cols, rows), Pillow.Resampling.BILINEAR))
        for plane in np.moveaxis(np.atleast_3d(truth), 2, 0)
    ]
    placed = np.full((*shape, len(planes)), np.nan, np.float32)
    placed[region.slices] = np.stack(planes, axis=2)
    return placed if truth.ndim == 3 else placed[..., 0]
