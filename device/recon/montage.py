"""Montage: pictures of one eye in several gaze directions, joined to one picture in the projection of the first.

Each picture is registered to those that are placed already (`estimation.masked_correlation`), and accepted only where
the correlation is high, unambiguous and rests on a large enough overlap; else it is left out, with the reason. Each
picture is scaled to the median of those before it in their common part, then blended with weights that fall to 0 at
the edge of its field. With a known scale in degrees a picture is placed by a rotation of the sphere of directions, else
by a shift and a rotation of the plane (`model.field_projection`). NUMERICS.md 11.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.errors import FrameError
from device.recon.estimation.masked_correlation import (
    FlatPicture,
    MaskedCorrelator,
    Match,
    flatten,
)
from device.recon.model.field_of_view import lit_field
from device.recon.model.field_projection import STILL, WIDEST_DEG, FieldProjection, Motion, Plane, Sphere
from device.recon.model.grid import Grid
from device.recon.model.resampling import block_mean
from device.values import Image, check_image_shape

MIN_PEAK, MIN_OVER_SECOND, MIN_OVERLAP = 0.5, 1.5, 0.2  # two different eyes have peaks of 0.26 to 0.44
# A small overlap correlates higher by chance, so its peak must be higher. Pictures of one retina have 0.70 to 0.96.
SMALL_OVERLAP, PEAK_PER_OVERLAP = 0.4, 0.5
FIELD_SAMPLES = 260  # across the field when registered: vessels stay resolved
FEATHER_SHARE = 0.25  # of the field's radius over which a picture's weight rises from its edge
RIM_PX = 3.0  # at the edge of a field, whose light falls off
EDGE_SIGMA_PX, EDGE_SHARE = 1.0, 0.3  # smoothing against noise; least share of the median light, as in `lit_field`
MAX_PICTURES, MIN_PX = 64, 32
ROUNDING_PX = 1e-6  # of a place that is a whole pixel

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Placement:
    """Place of one picture in a montage, relative to the first picture.

    What is at (r, c) of the first picture stands in this one at (r, c) + `shift_px`, turned about the
    picture's centre by `rotation_deg`. On the sphere this is exact at the centre only.

    Attributes
    ----------
    index
        Index of the picture.
    used
        True: it is part of the montage.
    shift_px
        Shift in pixels (rows, cols); None if it is not used.
    rotation_deg
        Rotation, counter-clockwise as displayed; None if it is not used.
    peak
        Normalised correlation with the picture to which it was registered; None for the first.
    overlap
        Their common part as a share of the smaller field; None for the first.
    reason
        Why it is not used; None if it is.
    """

    index: int
    used: bool
    shift_px: tuple[float, float] | None
    rotation_deg: float | None
    peak: float | None
    overlap: float | None
    reason: str | None = None

    @property
    def motion(self) -> Motion:
        """Motion from the first picture to this one, in pixels; only of a picture that is used."""
        assert self.shift_px is not None
        assert self.rotation_deg is not None
        return Motion(self.shift_px, self.rotation_deg)


@dataclass(frozen=True)
class Montage:
    """Joined picture, and the place of each picture in it.

    Attributes
    ----------
    picture
        Linear, (rows, cols) or (rows, cols, 3).
    origin_px
        (rows, cols) of pixel (0, 0) of the montage on the first picture.
    placed
        Place of each picture.
    px_per_deg
        Scale with which the pictures were placed on the sphere; None: on the plane.
    """

    picture: Image
    origin_px: tuple[int, int]
    placed: tuple[Placement, ...]
    px_per_deg: float | None = None

    @property
    def projection(self) -> Literal["sphere", "plane"]:
        """Name of the map between the pictures."""
        return "plane" if self.px_per_deg is None else "sphere"


def make_montage(
    pictures: Sequence[Image], progress: Callable[[int], None] = lambda _: None, px_per_deg: float | None = None
) -> Montage:
    """Return the montage of linear pictures (rows, cols) or (rows, cols, 3) of one size; FrameError otherwise.

    The first picture is always used; a montage of one is that picture without the outer RIM_PX of its field, which are
    0. `progress` gets the number of placed pictures.
    `px_per_deg`: pixels per degree of pictures that are linear in the field angle, FrameError if their corners are then
    more than WIDEST_DEG from the centre; None if unknown: the pictures are joined on the plane.
    """
    _refuse_different(pictures)
    _refuse_too_wide(pictures[0], px_per_deg)
    fields = [_field(given) for given in pictures]
    n = max(1, round(_diameter_px(fields) / FIELD_SAMPLES))
    box = _middle_box(fields)
    flats = [
        flatten(block_mean(_grey(given)[box], n), block_mean(field[box], n))
        for given, field in zip(pictures, fields, strict=True)
    ]
    placed = place(flats, n, progress, px_per_deg)
    used = [placement for placement in placed if placement.used]
    picture, origin_px = _blended(
        {placement.index: pictures[placement.index] for placement in used}, fields, used, projection_of(px_per_deg)
    )
    return Montage(picture, origin_px, tuple(placed), px_per_deg)


def projection_of(per_deg: float | None) -> FieldProjection:
    """Return the map between pictures with this scale, pixels or samples per degree; None: the plane."""
    return Plane() if per_deg is None else Sphere(per_deg)


def place(
    flats: Sequence[FlatPicture],
    n: int,
    progress: Callable[[int], None] = lambda _: None,
    px_per_deg: float | None = None,
) -> list[Placement]:
    """Return the placement of each picture; `n` pixels per sample, `px_per_deg` as in `make_montage`.

    Each round places the picture with the best match, and then registers the remaining ones to it as well. So a picture
    without a common part with the first one can be placed by another one.
    """
    projection = projection_of(None if px_per_deg is None else px_per_deg / n)
    placed = {0: Placement(0, True, STILL.shift, STILL.rotation_deg, None, None)}
    best: dict[int, tuple[Match, int]] = {}
    newest = 0
    waiting = set(range(1, len(flats)))
    while waiting:
        progress(len(placed))
        search = MaskedCorrelator(flats[newest], projection)
        for k in waiting:
            match = search.find(flats[k])
            if k not in best or _rank(match) > _rank(best[k][0]):
                best[k] = match, newest
        ready = [k for k in waiting if refusal(best[k][0]) is None]
        if not ready:
            break
        newest = max(ready, key=lambda k: _rank(best[k][0]))
        match, target = best[newest]
        found = Motion((match.shift[0] * n, match.shift[1] * n), match.rotation_deg)
        whole = projection_of(px_per_deg).composed(placed[target].motion, found)
        placed[newest] = Placement(newest, True, whole.shift, whole.rotation_deg, match.peak, match.overlap)
        waiting.remove(newest)
    for k in waiting:
        match, _ = best[k]
        placed[k] = Placement(k, False, None, None, match.peak, match.overlap, refusal(match))
    return [placed[k] for k in range(len(flats))]


def refusal(match: Match) -> str | None:
    """Return the reason why a match is not accepted; None if it is."""
    least = MIN_PEAK + PEAK_PER_OVERLAP * max(0.0, SMALL_OVERLAP - match.overlap)
    if match.peak <= least:
        return f"no picture shows the same part of the retina (correlation {match.peak:.2f}, more than {least:.2f})"
    if match.peak <= MIN_OVER_SECOND * match.second:
        return f"the place is ambiguous (correlation {match.peak:.2f}, {match.second:.2f} at another place)"
    if match.overlap <= MIN_OVERLAP:
        return f"the overlap of {match.overlap:.2f} of the field is too small (more than {MIN_OVERLAP})"
    return None


def _rank(match: Match) -> tuple[bool, float]:
    return refusal(match) is None, match.peak


def _refuse_different(pictures: Sequence[Image]) -> None:
    if not 0 < len(pictures) <= MAX_PICTURES:
        raise FrameError(f"a montage has 1 to {MAX_PICTURES} pictures, not {len(pictures)}", "Give fewer pictures.")
    for picture in pictures:
        check_image_shape(picture.shape)
        if min(picture.shape[:2]) < MIN_PX:
            raise FrameError(
                f"a picture of {picture.shape[0]} x {picture.shape[1]} pixels shows no vessels",
                f"Give pictures of at least {MIN_PX} x {MIN_PX} pixels.",
            )
    shapes = {picture.shape for picture in pictures}
    if len(shapes) > 1:
        listed = ", ".join(" x ".join(map(str, shape)) for shape in sorted(shapes))
        raise FrameError(f"the pictures have different sizes: {listed}", "Give pictures of one instrument.")
    if not all(np.isfinite(picture).all() for picture in pictures):
        raise FrameError("a picture holds values that are not numbers", "Reconstruct it again.")
    if not all(_grey(picture).max() > 0 for picture in pictures):
        raise FrameError("a picture is black", "Leave it out.")


def _refuse_too_wide(first: Image, px_per_deg: float | None) -> None:
    if px_per_deg is None:
        return
    half_px = float(np.hypot(*first.shape[:2])) / 2
    if not px_per_deg * WIDEST_DEG >= half_px:
        raise FrameError(
            f"with {px_per_deg:.3g} pixels per degree the corners of a picture of {first.shape[0]} x {first.shape[1]} "
            f"pixels are more than {WIDEST_DEG:g} degrees from its centre",
            "Give the head file of the instrument that took the pictures.",
        )


def _grey(picture: Image) -> Image:
    """Return the green channel, which shows the vessels best, or a grey picture as it is."""
    return picture if picture.ndim == 2 else picture[..., 1] if picture[..., 1].any() else picture.mean(axis=2)


def _field(picture: Image) -> Image:
    """Return where a picture is lit, (rows, cols), 0 or 1; everywhere if it has no dark border.

    The smoothing of `lit_field` moves the edge outwards. A dark rim would stand still in the camera while the retina
    moves, so that the field is cut to where the picture itself is lit, but for holes.
    """
    grey = _grey(picture)
    field = lit_field(grey, Grid.periodic((grey.shape[0], grey.shape[1]), 1, float("inf"))) > 0.5
    lit = ndimage.gaussian_filter(np.where(field, grey, 0), EDGE_SIGMA_PX) > EDGE_SHARE * np.median(grey[field])
    return np.asarray(field & ndimage.binary_fill_holes(lit), np.float32)


def _diameter_px(fields: Sequence[Image]) -> float:
    """Return the diameter of a disc with the area of the largest field."""
    return 2 * float(np.sqrt(max(float(mask.sum()) for mask in fields) / np.pi))


def _middle_box(fields: Sequence[Image]) -> tuple[slice, slice]:
    """Return the smallest box around the picture's centre that holds every field."""
    rows, cols = fields[0].shape
    lit = np.any([mask > 0.5 for mask in fields], axis=0)
    spans = []
    for axis, size in enumerate((rows, cols)):
        places = np.nonzero(lit.any(axis=1 - axis))[0]
        margin = min(int(places[0]), size - 1 - int(places[-1])) if len(places) else 0
        spans.append(slice(margin, size - margin))
    return spans[0], spans[1]


def _blended(
    pictures: Mapping[int, Image], fields: Sequence[Image], used: Sequence[Placement], projection: FieldProjection
) -> tuple[Image, tuple[int, int]]:
    """Return the weighted mean of the pictures in the projection of the first, and its origin in pixels of that."""
    first = pictures[used[0].index]
    middle = (np.array(first.shape[:2]) - 1) / 2
    border = _border(first.shape[:2]) - middle
    there = np.concatenate([projection.moved_back(border, placement.motion) + middle for placement in used])
    low = np.floor(there.min(axis=0) + ROUNDING_PX).astype(int)
    high = np.ceil(there.max(axis=0) - ROUNDING_PX).astype(int)
    size = int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1
    places = np.moveaxis(np.indices(size, dtype=np.float64), 0, -1) + low - middle
    total = np.zeros((*size, *first.shape[2:]), np.float32)
    weights = np.zeros(size, np.float32)
    for placement in used:
        at = np.moveaxis(projection.moved(places, placement.motion) + middle, -1, 0)
        weight = ndimage.map_coordinates(_feather(fields[placement.index]), at, order=1)
        moved = _resampled(pictures[placement.index], at)
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
        int(low[0]),
        int(low[1]),
    )


def _border(shape: tuple[int, ...]) -> Floats:
    """Return the pixels (n, 2) along the four sides of a picture."""
    outside = np.ones(shape, bool)
    outside[1:-1, 1:-1] = False
    return np.argwhere(outside).astype(np.float64)


def _feather(field: Image) -> Image:
    """Return the weight of a picture's pixels: 0 at the edge of its field, 1 at FEATHER_SHARE of the radius inside."""
    depth = ndimage.distance_transform_edt(np.pad(field > 0.5, 1))[1:-1, 1:-1]
    depth = depth - RIM_PX
    return np.asarray(np.clip(depth / max(FEATHER_SHARE * float(depth.max()), 1.0), 0, 1), np.float32)


def _resampled(picture: Image, at: Floats) -> Image:
    """Return the picture at places (2, rows, cols) by cubic interpolation, 0 outside."""
    planes = [picture] if picture.ndim == 2 else [picture[..., c] for c in range(3)]
    moved = [ndimage.map_coordinates(channel, at, order=3) for channel in planes]
    return np.asarray(moved[0] if len(moved) == 1 else np.stack(moved, axis=2), np.float32)
