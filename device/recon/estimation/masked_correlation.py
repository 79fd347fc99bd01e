"""Masked normalised correlation: shift and rotation between two pictures that show parts of one retina.

The lit fields of two gaze directions overlap in a lens only, and a plain correlation follows the shape of the fields.
The normalised correlation over the pixels that are lit in both pictures, for every shift at once, is a quotient of
correlations of pictures and masks (D. Padfield, IEEE Transactions on Image Processing 21, 2706, 2012). NUMERICS.md 11.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from device.recon.model.field_projection import FieldProjection, Motion, Plane
from device.values import Image

FLATTEN_SIGMA_SAMPLES = 10.0  # of the local mean
SMOOTH_SIGMA_SAMPLES = 1.2  # against noise
MAX_CONTRAST = 0.3  # of flat pictures: a lesion or a reflex must not outweigh all vessels
MIN_OVERLAP = 0.12  # of a field: with less the highest of all correlations is one of chance
SECOND_SAMPLES = 8  # distance from the peak at which another one begins
OUTER_SHARE = 0.2  # of the radius of the common part: a match without shift must hold without it
SECOND_OVERLAP = 0.2  # of another place, as much as a picture needs to be placed
ANGLES_DEG = tuple(float(angle) for angle in range(-8, 9, 2))  # coarse search: at most 1 degree off (NUMERICS.md 11)
REFINEMENTS = 8  # of shift and rotation; they converge in three or four
MAX_STEP_DEG = 1.7  # of one of them

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Match:
    """Best shift and rotation of a picture against a reference, in samples and degrees.

    What is at p in the reference stands in the picture where `field_projection` moves it: on the plane at R(p + shift),
    both from the centre; R turns by `rotation_deg` counter-clockwise as displayed. `peak` is the normalised
    correlation, -1 to 1, `second` the highest one elsewhere, `overlap` the common part of both fields as a share of the
    smaller one.
    """

    shift: tuple[float, float]
    rotation_deg: float
    peak: float
    second: float
    overlap: float


@dataclass(frozen=True)
class FlatPicture:
    """Picture divided by its local mean, minus 1, and its field (0 or 1), both (rows, cols) float32."""

    detail: Image
    field: Image


def flatten(picture: Image, field: Image) -> FlatPicture:
    """Return a linear picture (rows, cols) without its shading; `field` (0 to 1) is where it is lit."""
    inside = np.asarray(ndimage.binary_erosion(field > 0.5, iterations=4), np.float32)
    weight = np.maximum(ndimage.gaussian_filter(inside, FLATTEN_SIGMA_SAMPLES), 0.05)
    local = ndimage.gaussian_filter(picture * inside, FLATTEN_SIGMA_SAMPLES) / weight
    level = float((picture * inside).sum() / max(inside.sum(), 1))
    detail = (picture / np.maximum(local, max(0.05 * level, 1e-30)) - 1) * inside
    detail = np.clip(ndimage.gaussian_filter(detail, SMOOTH_SIGMA_SAMPLES) * inside, -MAX_CONTRAST, MAX_CONTRAST)
    return FlatPicture(np.asarray(detail, np.float32), inside)


class MaskedCorrelator:
    """Search for other pictures in one reference; the spectra of the reference are computed once.

    The correlation is that of the plane; `projection` (in samples; None: the plane) refines its best place.
    """

    def __init__(self, reference: FlatPicture, projection: FieldProjection | None = None) -> None:
        self._reference, self._projection = reference, projection
        self._shape = tuple(fft.next_fast_len(2 * size, real=True) for size in reference.field.shape)
        self._area = float(reference.field.sum())
        self._spectra = self._of(reference)

    def find(self, picture: FlatPicture) -> Match:
        """Return the best match over all shifts and rotations within ANGLES_DEG.

        The peak of a match without shift is that of the inner part of the field, if that is lower: a pattern that
        stands still in the camera is no match.
        """
        found = max((self._at(picture, angle) for angle in ANGLES_DEG), key=lambda match: match.peak)
        turn_deg = refined(self._reference, picture, found, self._projection).rotation_deg
        found = self._at(picture, turn_deg)  # with the rotation taken out, peak and shift are those of the whole field
        better = refined(self._reference, picture, found, self._projection)
        best = better if better.peak > found.peak else found
        stands_still = max(map(abs, best.shift)) < SECOND_SAMPLES
        return replace(best, peak=min(best.peak, self._inner_peak(picture, best))) if stands_still else best

    def _inner_peak(self, picture: FlatPicture, match: Match) -> float:
        """Return the correlation at a match without the outer part of the field; -1 where nothing is left.

        What stands still in the camera lies at the edge: the rim of the field, its shade, a reflex. Where the retina
        stands still, its middle agrees as well.
        """
        back = turned(picture, -match.rotation_deg)
        moved = ndimage.shift(back.detail, [-shift for shift in match.shift], order=1)
        lit = ndimage.shift(back.field, [-shift for shift in match.shift], order=1) > 0.99
        depth = ndimage.distance_transform_edt(np.pad((self._reference.field > 0) & lit, 1))[1:-1, 1:-1]
        inner = depth > OUTER_SHARE * depth.max()
        if not inner.any():
            return -1.0
        return float(_normalised(self._reference.detail[inner]) @ _normalised(moved[inner]))

    def _at(self, picture: FlatPicture, rotation_deg: float) -> Match:
        """Return the best shift of a picture that was turned by `rotation_deg`."""
        back = turned(picture, -rotation_deg)
        correlation, overlap = self._surface(self._of(back), float(back.field.sum()))
        row, col = np.unravel_index(int(correlation.argmax()), correlation.shape)
        peak = float(correlation[row, col])
        at = int(row), int(col)
        place = self._top(correlation, at, 0), self._top(correlation, at, 1)
        return Match(place, rotation_deg, peak, _second(correlation, overlap, at), float(overlap[row, col]))

    def _of(self, picture: FlatPicture) -> tuple[NDArray[np.complex128], ...]:
        """Return the spectra of detail, field and squared detail."""
        detail = picture.detail.astype(np.float64)
        field = picture.field.astype(np.float64)
        return tuple(fft.rfft2(image, self._shape) for image in (detail, field, detail * detail))

    def _surface(self, moved: tuple[NDArray[np.complex128], ...], area: float) -> tuple[Floats, Floats]:
        """Return correlation (-1 where the overlap is too small) and overlap for every shift, cyclic."""
        (a, field_a, a2) = self._spectra
        (b, field_b, b2) = moved

        def correlate(first: NDArray[np.complex128], other: NDArray[np.complex128]) -> Floats:
            return np.asarray(fft.irfft2(np.conj(first) * other, self._shape))

        count = correlate(field_a, field_b)
        share = count / max(min(self._area, area), 1.0)
        count = np.maximum(count, 1.0)
        sum_a = correlate(a, field_b)
        sum_b = correlate(field_a, b)
        covariance = correlate(a, b) - sum_a * sum_b / count
        variance_a = correlate(a2, field_b) - sum_a**2 / count
        variance_b = correlate(field_a, b2) - sum_b**2 / count
        scale = np.sqrt(np.maximum(variance_a, 1e-12) * np.maximum(variance_b, 1e-12))
        return np.where(share > MIN_OVERLAP, covariance / scale, -1.0), share

    def _top(self, surface: Floats, place: tuple[int, int], axis: int) -> float:
        """Return the shift along an axis at the top of the parabola through the peak and its neighbours."""
        size = surface.shape[axis]
        values = []
        for step in (-1, 0, 1):
            at = list(place)
            at[axis] = (at[axis] + step) % size
            values.append(float(surface[at[0], at[1]]))
        curve = values[0] - 2 * values[1] + values[2]
        off = 0.5 * (values[0] - values[2]) / curve if curve < 0 else 0.0
        whole = place[axis] if place[axis] < size / 2 else place[axis] - size
        return whole + float(np.clip(off, -0.5, 0.5))


def refined(
    reference: FlatPicture, picture: FlatPicture, start: Match, projection: FieldProjection | None = None
) -> Match:
    """Return a match with shift and rotation improved by Gauss-Newton steps on the normalised difference.

    `projection`: map between the pictures, in samples; None: the plane. The start must be nearer than the width of a
    vessel (enhanced correlation coefficient: G. Evangelidis and E. Psarakis, IEEE TPAMI 30, 1858, 2008). A step moves
    the reference before the motion found so far, which makes the slopes those of the moved picture.
    """
    projection = projection or Plane()
    middle = (np.array(reference.field.shape) - 1) / 2
    places = np.moveaxis(np.indices(reference.field.shape, dtype=np.float64), 0, -1) - middle
    rates = _rates(projection, places)
    coefficients = ndimage.spline_filter(picture.detail, order=3, output=np.float32)
    motion = Motion(start.shift, start.rotation_deg)
    best = start
    for _ in range(REFINEMENTS):
        at = np.moveaxis(projection.moved(places, motion) + middle, -1, 0)
        both = (reference.field > 0) & (ndimage.map_coordinates(picture.field, at, order=1) > 0.99)
        if both.sum() < MIN_OVERLAP * reference.field.sum():
            return best
        moved: Image = ndimage.map_coordinates(coefficients, at, order=3, prefilter=False)
        down = np.asarray(np.gradient(moved, axis=0))
        right = np.asarray(np.gradient(moved, axis=1))
        a, b = (_normalised(image[both]) for image in (reference.detail, moved))
        correlation = float(a @ b)
        if correlation > best.peak or best is start:
            best = replace(best, shift=motion.shift, rotation_deg=motion.rotation_deg, peak=correlation)
        scale = max(float(np.linalg.norm(moved[both] - moved[both].mean())), 1e-30)
        slopes = np.stack([(down * rate[..., 0] + right * rate[..., 1])[both] for rate in rates], axis=1) / scale
        step = np.linalg.lstsq(slopes - slopes.mean(axis=0), a - b, rcond=None)[0]
        first, second = np.clip(step[:2], -2, 2)
        small = Motion((float(first), float(second)), float(np.clip(step[2], -MAX_STEP_DEG, MAX_STEP_DEG)))
        motion = projection.composed(small, motion)
    return best


def _rates(projection: FieldProjection, places: Floats) -> list[Floats]:
    """Return the velocity of places (..., 2) for a shift along rows and cols, per sample, and a rotation, per degree.

    Central differences over half a sample and half a degree; maps of the plane and the sphere are smooth there.
    """
    half = 0.25
    pairs = [(Motion((h, 0.0), 0.0), Motion((0.0, h), 0.0), Motion((0.0, 0.0), h)) for h in (half, -half)]
    return [
        np.asarray((projection.moved(places, ahead) - projection.moved(places, behind)) / (2 * half))
        for ahead, behind in zip(*pairs, strict=True)
    ]


def _normalised(values: Image) -> Floats:
    """Return values with mean 0 and norm 1."""
    centred = values.astype(np.float64) - values.mean(dtype=np.float64)
    return np.asarray(centred / max(float(np.linalg.norm(centred)), 1e-30))


def turned(picture: FlatPicture, rotation_deg: float) -> FlatPicture:
    """Return a picture turned about its centre, counter-clockwise as displayed."""
    if rotation_deg == 0:
        return picture
    detail = ndimage.rotate(picture.detail, rotation_deg, reshape=False, order=1)
    field = ndimage.rotate(picture.field, rotation_deg, reshape=False, order=1) > 0.99
    return FlatPicture(np.asarray(detail * field, np.float32), np.asarray(field, np.float32))


def _second(surface: Floats, overlap: Floats, peak: tuple[int, int]) -> float:
    """Return the highest maximum farther than SECOND_SAMPLES from the peak, cyclic; -1 without one.

    The ridge of the peak along a vessel is no second place: it has no maximum of its own. Neither is a place where the
    pictures have less than SECOND_OVERLAP in common, where high correlations are of chance.
    """
    size = 2 * SECOND_SAMPLES + 1
    is_top = (surface >= ndimage.maximum_filter(surface, size, mode="wrap")) & (overlap > SECOND_OVERLAP)
    far = np.where(is_top, surface, -1.0)
    reach = np.arange(-SECOND_SAMPLES, SECOND_SAMPLES + 1)
    far[np.ix_((peak[0] + reach) % surface.shape[0], (peak[1] + reach) % surface.shape[1])] = -1
    return float(far.max())
