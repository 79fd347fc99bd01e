"""Search for a layout of lenslets: number of lenses, and focus, by the detail expected over field and refraction.

The picture is that of a linear filter which knows the head's light, the eye's refraction, and the PSF averaged over the
field (OPTICS.md 2.10).
"""

from collections.abc import Iterator, Sequence
from itertools import product
from math import cos, pi, radians, sin, tan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from device.config.element import Lenses
from device.config.head_file import OpticsSpec
from device.config.scene import ElementFlaws
from device.optics.diffuser import Refraction, caustic
from device.optics.lens_layout import centroidal
from device.optics.lenslets import spots

COUNTS = (5, 8, 12, 16, 22, 32, 48)
FOCI_DPT = (0.0, 6.0, 12.0)  # behind the sensor at the axis, because the lenses are too strong at the edge
REFRACTIONS_DPT = (-10.0, 0.0, 10.0)
RINGS = ((0.0, 0.06), (0.45, 0.36), (0.75, 0.42), (1.0, 0.16))  # of the half field, and their share of its area
SPOKES, FIRST_SPOKE_RAD = 4, 0.4
TOLERANCES = ElementFlaws(focal_spread=0.02, surface_waves=0.07, centre_um=2.0)
SPECTRUM, LOWEST_PER_DEG = 5e-4, 0.1  # of a retina's contrast, at 1 / degree and falling with its square; and the band

Complex = NDArray[np.complexfloating]


class Figure(NamedTuple):
    """Expected correlation of the detail with the truth: at the axis and the edge of the field, and at worst.

    `mean` is over the field and the refractions; `worst` is the least refraction's mean over the field.
    """

    axis: float
    edge: float
    mean: float
    worst: float


class Candidate(NamedTuple):
    """One layout of the search: lenses, how far they focus behind the sensor at the axis, dpt, and its figures."""

    lenses: Lenses
    focus_dpt: float
    figure: Figure


def search(
    optics: OpticsSpec, pitch_um: float, object_e: float, seed: int, counts: Sequence[int] = COUNTS
) -> Iterator[Candidate]:
    """Yield a candidate for each number of lenses and each focus.

    `object_e`: mean electrons of the object in a pixel of `pitch_um`.
    """
    for count, focus_dpt in product(counts, FOCI_DPT):
        lenses = centroidal(count, optics.iris_um, focal_um(optics, focus_dpt), seed)
        element = optics.element.model_copy(update={"kind": "lenslets", "lenses": lenses})
        made = optics.model_copy(update={"element": element})
        yield Candidate(lenses, focus_dpt, figure(made, pitch_um, object_e, seed))


def focal_um(optics: OpticsSpec, focus_dpt: float) -> float:
    """Return the focal length, um, of lenses that focus an emmetropic eye's light behind the sensor by dpt at the eye.

    The centre of the field is then as far out of focus as an eye of that hyperopia, and the edge is nearer to focus.
    """
    return 1 / (1 / optics.diffuser_to_sensor_um - 1e-6 * optics.angular_magnification**2 * focus_dpt)


def figure(optics: OpticsSpec, pitch_um: float, object_e: float, seed: int) -> Figure:
    """Return the expected detail of a head with lenslets of the tolerances that can be made, or with a diffuser."""
    by_place = [_correlations(optics, pitch_um, object_e, seed, Refraction(m_dpt)) for m_dpt in REFRACTIONS_DPT]
    shares = [share for *_, share in _places(optics)]
    over_field = [float(np.dot(shares, found)) for found in by_place]
    relaxed = by_place[REFRACTIONS_DPT.index(0.0)]
    edge = float(np.mean(relaxed[-SPOKES:]))
    return Figure(relaxed[0], edge, float(np.mean(over_field)), min(over_field))


def _places(optics: OpticsSpec) -> Iterator[tuple[float, float, float]]:
    """Yield the tangents (right, down) of chief rays at the iris, and the share of the field that each stands for."""
    for ring, share in RINGS:
        tangent = tan(radians(optics.angular_magnification * ring * optics.field_deg / 2))
        turns = [FIRST_SPOKE_RAD + 2 * pi * spoke / SPOKES for spoke in range(SPOKES)] if ring else [0.0]
        for turn in turns:
            yield tangent * cos(turn), tangent * sin(turn), share / len(turns)


def _correlations(
    optics: OpticsSpec, pitch_um: float, object_e: float, seed: int, refraction: Refraction
) -> list[float]:
    """Return the correlation of detail and truth at each place, by the filter of the PSF averaged over the field."""
    places = list(_places(optics))
    if optics.element.kind == "diffuser":
        psfs = [caustic(optics, pitch_um, seed, refraction, 1)] * len(places)
    else:
        slopes = [(right, down) for right, down, _ in places]
        psfs = [spots(optics, pitch_um, seed, refraction, 1, None, TOLERANCES, slope) for slope in slopes]
    transfers = [fft.rfft2(psf) for psf in psfs]
    average = np.tensordot([share for *_, share in places], transfers, axes=1)
    rows, cols = psfs[0].shape
    px_per_deg = optics.geometry(pitch_um).px_per_deg
    per_deg = px_per_deg * np.hypot(fft.fftfreq(rows)[:, None], fft.rfftfreq(cols)[None, :])
    retina = np.where(per_deg > LOWEST_PER_DEG, SPECTRUM / np.maximum(per_deg, LOWEST_PER_DEG) ** 2, 0.0)
    return [_correlation(transfer, average, retina * px_per_deg**2, 1 / object_e) for transfer in transfers]


def _correlation(transfer: Complex, known: Complex, retina: NDArray[np.float64], noise: float) -> float:
    """Return the correlation with the truth of the Wiener filter's picture, whose filter is of the known transfer."""
    wiener = known.conj() * retina / (np.abs(known) ** 2 * retina + noise)
    passed = wiener * transfer
    power = (np.abs(passed) ** 2 * retina + np.abs(wiener) ** 2 * noise).sum()
    return float((retina * passed.real).sum() / np.sqrt(retina.sum() * power))
