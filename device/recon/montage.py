"""Montage: pictures of one eye in several gaze directions, placed on the plane of the first one.

Each picture is registered to those that are placed already (`estimation.masked_correlation`), and accepted only where
the correlation is high, unambiguous and rests on a large enough overlap; else it stays apart, with the reason. Blended
with weights that fall to 0 at the edge of each field. The plane is that of the first picture: no projection onto the
sphere of the eye. NUMERICS.md 11.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.errors import FrameError
from device.recon.estimation.masked_correlation import (
    FlatPicture,
    MaskedCorrelator,
    Match,
    flatten,
    rotation_matrix,
)
from device.recon.model.field_of_view import lit_field
from device.recon.model.grid import Grid
from device.recon.model.resampling import block_mean
from device.values import Image, check_image_shape

LEAST_PEAK, LEAST_OVER_SECOND, LEAST_OVERLAP = 0.5, 1.5, 0.2  # two different eyes have peaks of 0.24 to 0.51
# A small overlap correlates higher by chance: more is asked of it. Pictures of one retina have 0.79 to 0.94.
SMALL_OVERLAP, PEAK_PER_OVERLAP = 0.4, 0.5
FIELD_SAMPLES = 260  # across the field when registered: vessels stay resolved
FEATHER_SHARE = 0.25  # of the field's radius over which a picture's weight rises from its edge
RIM_PX = 3.0  # at the edge of a field, whose light falls off
MOST_PICTURES, LEAST_PX = 64, 32

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Placement:
    """Place of one picture in a montage, relative to the first picture.

    What is at (r, c) of the first picture stands in this one at (r, c) + `shift_px`, turned about the picture's centre
    by `rotation_deg`, counter-clockwise as displayed. `peak` is the normalised correlation with the picture to which it
    was registered, `overlap` their common part as a share of the smaller field; both None for the first. `reason` says
    why a picture is not used.
    """

    index: int
    used: bool
    shift_px: tuple[float, float] | None
    rotation_deg: float | None
    peak: float | None
    overlap: float | None
    reason: str | None = None


@dataclass(frozen=True)
class Montage:
    """Joined picture, linear (rows, cols) or (rows, cols, 3), and the place of each picture.

    Pixel (0, 0) of the montage is at `origin_px` (rows, cols) of the first picture.
    """

    picture: Image
    origin_px: tuple[int, int]
    placed: tuple[Placement, ...]


def make_montage(pictures: Sequence[Image], progress: Callable[[int], None] = lambda _: None) -> Montage:
    """Return the montage of linear pictures (rows, cols) or (rows, cols, 3) of one size; FrameError otherwise.

    The first picture is always used; a montage of one is that picture. `progress` gets the number of placed pictures.
    """
    _refuse_different(pictures)
    fields = [_field(one) for one in pictures]
    n = max(1, round(_diameter_px(fields) / FIELD_SAMPLES))
    box = _middle_box(fields)
    flats = [
        flatten(block_mean(_grey(one)[box], n), block_mean(field[box], n))
        for one, field in zip(pictures, fields, strict=True)
    ]
    placed = place(flats, n, progress)
    used = [one for one in placed if one.used]
    picture, origin_px = _blended({one.index: pictures[one.index] for one in used}, fields, used)
    return Montage(picture, origin_px, tuple(placed))


def place(flats: Sequence[FlatPicture], n: int, progress: Callable[[int], None] = lambda _: None) -> list[Placement]:
    """Return the placement of each picture; `n` pixels per sample.

    The picture with the best match is placed first, and the rest are searched in it too, so that a picture that has
    nothing in common with the first can be placed by another one.
    """
    placed = {0: Placement(0, True, (0.0, 0.0), 0.0, None, None)}
    best: dict[int, tuple[Match, int]] = {}
    newest, waiting = 0, set(range(1, len(flats)))
    while waiting:
        progress(len(placed))
        search = MaskedCorrelator(flats[newest])
        for k in waiting:
            match = search.find(flats[k])
            if k not in best or _rank(match) > _rank(best[k][0]):
                best[k] = match, newest
        ready = [k for k in waiting if refusal(best[k][0]) is None]
        if not ready:
            break
        newest = max(ready, key=lambda k: _rank(best[k][0]))
        match, target = best[newest]
        placed[newest] = _composed(newest, match, placed[target], n)
        waiting.remove(newest)
    for k in waiting:
        match, _ = best[k]
        placed[k] = Placement(k, False, None, None, match.peak, match.overlap, refusal(match))
    return [placed[k] for k in range(len(flats))]


def refusal(match: Match) -> str | None:
    """Return the reason why a match is not accepted; None if it is."""
    least = LEAST_PEAK + PEAK_PER_OVERLAP * max(0.0, SMALL_OVERLAP - match.overlap)
    if match.peak <= least:
        return f"no picture shows the same part of the retina (correlation {match.peak:.2f}, more than {least:.2f})"
    if match.peak <= LEAST_OVER_SECOND * match.second:
        return f"the place is ambiguous (correlation {match.peak:.2f}, {match.second:.2f} at another place)"
    if match.overlap <= LEAST_OVERLAP:
        return f"the overlap of {match.overlap:.2f} of the field is too small (more than {LEAST_OVERLAP})"
    return None


def _rank(match: Match) -> tuple[bool, float]:
    return refusal(match) is None, match.peak


def _composed(index: int, match: Match, target: Placement, n: int) -> Placement:
    """Return the placement relative to the first picture of a match with a picture that is placed.

    p -> R2(R1(p + s1) + s2) = R2 R1 (p + s1 + R1^-1 s2).
    """
    assert target.shift_px is not None
    assert target.rotation_deg is not None
    own_px = rotation_matrix(-target.rotation_deg) @ (np.array(match.shift) * n)
    shift_px = (target.shift_px[0] + float(own_px[0]), target.shift_px[1] + float(own_px[1]))
    return Placement(index, True, shift_px, target.rotation_deg + match.rotation_deg, match.peak, match.overlap)


def _refuse_different(pictures: Sequence[Image]) -> None:
    if not 0 < len(pictures) <= MOST_PICTURES:
        raise FrameError(f"a montage has 1 to {MOST_PICTURES} pictures, not {len(pictures)}", "Give fewer pictures.")
    for one in pictures:
        check_image_shape(one.shape)
        if min(one.shape[:2]) < LEAST_PX:
            raise FrameError(
                f"a picture of {one.shape[0]} x {one.shape[1]} pixels shows no vessels",
                f"Give pictures of at least {LEAST_PX} x {LEAST_PX} pixels.",
            )
    shapes = {one.shape for one in pictures}
    if len(shapes) > 1:
        listed = ", ".join(" x ".join(map(str, shape)) for shape in sorted(shapes))
        raise FrameError(f"the pictures have different sizes: {listed}", "Give pictures of one instrument.")
    if not all(np.isfinite(one).all() for one in pictures):
        raise FrameError("a picture holds values that are not numbers", "Reconstruct it again.")
    if not all(_grey(one).max() > 0 for one in pictures):
        raise FrameError("a picture is black", "Leave it out.")


def _grey(picture: Image) -> Image:
    """Return the green channel, which shows the vessels best, or a grey picture as it is."""
    return picture if picture.ndim == 2 else picture[..., 1] if picture[..., 1].any() else picture.mean(axis=2)


def _field(picture: Image) -> Image:
    """Return where a picture is lit, (rows, cols), 0 or 1; everywhere if it has no dark border."""
    grey = _grey(picture)
    return lit_field(grey, Grid.periodic((grey.shape[0], grey.shape[1]), 1, float("inf")))


def _diameter_px(fields: Sequence[Image]) -> float:
    """Return the diameter of a disc with the area of the largest field."""
    return 2 * float(np.sqrt(max(float(one.sum()) for one in fields) / np.pi))


def _middle_box(fields: Sequence[Image]) -> tuple[slice, slice]:
    """Return the smallest box around the picture's centre that holds every field."""
    rows, cols = fields[0].shape
    lit = np.any([one > 0.5 for one in fields], axis=0)
    spans = []
    for axis, size in enumerate((rows, cols)):
        places = np.nonzero(lit.any(axis=1 - axis))[0]
        margin = min(int(places[0]), size - 1 - int(places[-1])) if len(places) else 0
        spans.append(slice(margin, size - margin))
    return spans[0], spans[1]


def _blended(
    pictures: Mapping[int, Image], fields: Sequence[Image], used: Sequence[Placement]
) -> tuple[Image, tuple[int, int]]:
    """Return the weighted mean of the pictures on the plane of the first, and its origin in pixels of the first."""
    first = pictures[used[0].index]
    rows, cols = first.shape[:2]
    corners = np.array([[0, 0], [0, cols - 1], [rows - 1, 0], [rows - 1, cols - 1]], float)
    middle = (np.array([rows, cols]) - 1) / 2
    there = np.concatenate([_in_first(corners - middle, one) + middle for one in used])
    low, high = np.floor(there.min(axis=0)).astype(int), np.ceil(there.max(axis=0)).astype(int)
    size = tuple(int(one) for one in high - low + 1)
    total = np.zeros((*size, *first.shape[2:]), np.float32)
    weights = np.zeros(size, np.float32)
    for one in used:
        feather = _feather(fields[one.index])
        turn = rotation_matrix(one.rotation_deg or 0.0)
        offset = middle + turn @ (low - middle + np.array(one.shift_px))
        weight = ndimage.affine_transform(feather, turn, offset, size, order=1)
        moved = _resampled(pictures[one.index], turn, offset, size)
        both = (weights > 0.1) & (weight > 0.1)
        gain = 1.0
        if both.any():  # the same retina in another exposure
            present = _grey(total)[both] / weights[both]
            gain = float(np.median(present) / max(float(np.median(_grey(moved)[both])), 1e-30))
        total += gain * moved * (weight if first.ndim == 2 else weight[..., None])
        weights += weight
    scale = np.maximum(weights, 1e-6)
    blended = total / (scale if first.ndim == 2 else scale[..., None])
    return np.asarray(blended * (weights > 0 if first.ndim == 2 else (weights > 0)[..., None]), np.float32), (
        int(low[0]), int(low[1]),
    )  # fmt: skip


def _in_first(points: Floats, placement: Placement) -> Floats:
    """Return where points of a picture, from its centre, are in the first one: p = R^-1 q - shift."""
    back = points @ rotation_matrix(-(placement.rotation_deg or 0.0)).T
    return np.asarray(back - np.array(placement.shift_px))


def _feather(field: Image) -> Image:
    """Return the weight of a picture's pixels: 0 at the edge of its field, 1 at FEATHER_SHARE of the radius inside."""
    depth = ndimage.distance_transform_edt(np.pad(field > 0.5, 1))[1:-1, 1:-1]
    depth = depth - RIM_PX
    return np.asarray(np.clip(depth / max(FEATHER_SHARE * float(depth.max()), 1.0), 0, 1), np.float32)


def _resampled(picture: Image, turn: Floats, offset: Floats, size: tuple[int, ...]) -> Image:
    """Return the picture on the plane of the first one by cubic interpolation, 0 outside."""
    planes = [picture] if picture.ndim == 2 else [picture[..., c] for c in range(3)]
    moved = [ndimage.affine_transform(one, turn, offset, size, order=3) for one in planes]
    return np.asarray(moved[0] if len(moved) == 1 else np.stack(moved, axis=2), np.float32)
