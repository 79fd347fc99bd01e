"""PSF of lenslets at the iris by one Fourier transform a lens, exact in the Fresnel approximation; OPTICS.md 2.8.

The paper's future work: "a properly-designed microlens array" (Xue et al. 2020) "or customized aperiodic microlens
array" (Kuo et al. 2020).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from device.config.element import ElementSpec, half_widths_um, iris_places_um
from device.config.head_file import OpticsSpec
from device.config.scene import ElementFlaws
from device.optics.diffuser import EMMETROPIA, Beam, Grid, Refraction, onto_pixels, spectral_lines_um
from device.values import Image

Floats = NDArray[np.float64]
Slope = tuple[float, float]

WINDOW_UM = 500.0  # of a spot in focus; what is diffracted beyond it is folded into it
CORNER = 1.5  # farthest place of a cell, over its half width
FARTHEST = 1.07  # a spot stands up to this times its lens from the axis: in front of an eye of -20 dpt
LINE_D_UM, LINE_F_UM, LINE_C_UM = 0.5876, 0.4861, 0.6563  # of the Abbe number


class LensState(NamedTuple):
    """What is not ideal of lenses: how they were made and stand, and whether their image surface is curved."""

    flaws: ElementFlaws = ElementFlaws()
    curved: bool = False


IDEAL = LensState()


@dataclass(frozen=True)
class _Lens:
    """One lens, or the clear gap around it, in the light of one place of the retina and one wavelength."""

    optics: OpticsSpec
    element: ElementSpec
    number: int
    refraction: Refraction
    slope: Slope
    wavelength_um: float
    is_gap: bool

    @property
    def centre_um(self) -> Floats:
        """Vertex of the lens (right, down), um."""
        return np.array(self.element.lenses[self.number][:2])

    @property
    def curvature_per_um(self) -> Floats:
        """Curvature K (2, 2) of the wavefront behind the lens against that which ends in a point on the sensor."""
        m, j0, j45 = self.refraction
        eye = 1e-6 * self.optics.angular_magnification**2 * np.array([[m + j0, j45], [j45, m - j0]])
        flat = np.eye(2) / self.optics.diffuser_to_sensor_um - eye
        if self.is_gap:
            return flat
        focal_um = self.element.lenses[self.number][2] * _focal_scale(self.element, self.wavelength_um)
        tilt = np.array(self.slope)
        oblique = (1 + 1 / self.element.index) * (tilt @ tilt) * np.eye(2) / 2 + np.outer(tilt, tilt)
        return np.asarray(flat - (np.eye(2) + oblique) / focal_um)


class _Samples(NamedTuple):
    """Samples of a lens around its vertex, um, and the square of sensor pixels, `step` samples wide, they turn into."""

    x_um: Floats
    dx_um: float
    pixels: int
    step: int

    def edge(self, inside_um: Floats) -> Floats:
        """Return the transmission of places this far inside an edge, with an edge one sample wide, 0 to 1."""
        return np.clip(inside_um / self.dx_um + 0.5, 0, 1)

    def disc(self, right_um: float, down_um: float, radius_um: float) -> Floats:
        """Return the transmission of a round stop around (right, down)."""
        return self.edge(radius_um - np.hypot(self.x_um[None, :] - right_um, self.x_um[:, None] - down_um))


def spots(
    optics: OpticsSpec,
    pitch_um: float,
    seed: int,
    refraction: Refraction = EMMETROPIA,
    lines: int = 3,
    beam: Beam | None = None,
    flaws: ElementFlaws = IDEAL.flaws,
    slope: Slope = (0.0, 0.0),
) -> Image:
    """Return the intensity on the sensor from one retinal point behind lenslets: float32 (n, n), the axis in n//2.

    The sum is 1, less what a `beam`, black gaps and dust take. `slope` is the tangent of the chief ray's angle at the
    iris (right, down), off the axis the lenses are stronger; (0, 0): on the axis. `seed` selects the flaws. Every
    pixel integrates over its whole area; lenses, and `lines` wavelengths across the bandwidth, add incoherently.
    """
    element = with_flaws(optics.element, flaws, seed)
    halves_um = half_widths_um(element.lenses, optics.iris_um)
    places_um, _ = iris_places_um(optics.iris_um)
    grains_um = np.random.default_rng((seed, 73)).choice(places_um, flaws.dust_grains)
    size = 2 * math.ceil(reach_um(optics) / pitch_um) + 1
    psf, iris_um2 = np.zeros((size, size)), 0.0
    has_clear_gaps = element.aperture_um is not None and element.gaps == "clear"
    for wavelength_um in spectral_lines_um(optics, lines):
        for number, half_um in enumerate(halves_um):
            for is_gap in (False, True) if has_clear_gaps else (False,):
                lens = _Lens(optics, element, number, refraction, slope, wavelength_um, is_gap)
                samples = _samples(lens, pitch_um, half_um)
                cell = _cell(lens, samples)
                iris_um2 += 0.0 if is_gap else float(cell.sum()) * samples.dx_um**2
                cell *= _stops(lens, samples, beam)
                for right_um, down_um in grains_um - lens.centre_um:
                    cell *= 1 - samples.disc(right_um, down_um, flaws.dust_um / 2)
                waves = _quadratic(lens.curvature_per_um, samples.x_um) / (2 * wavelength_um)
                if flaws.surface_waves and not is_gap:
                    waves += flaws.surface_waves * _surface(samples, cell, np.random.default_rng((seed, 71, number)))
                at_px = refraction.warp(optics) @ lens.centre_um / pitch_um + size // 2
                _add_spot(psf, cell, waves, samples, at_px)
    return np.asarray(psf / iris_um2, np.float32)


def reach_um(optics: OpticsSpec) -> float:
    """Return the distance from the axis within which the light of a point on the axis arrives on the sensor, um."""
    return FARTHEST * max(math.hypot(*lens[:2]) for lens in optics.element.lenses) + WINDOW_UM / 2


def with_flaws(element: ElementSpec, flaws: ElementFlaws, seed: int) -> ElementSpec:
    """Return the element with the focal lengths and centres of lenses that were made with these flaws, and moved."""
    lenses = np.array(element.lenses)
    drawn = np.random.default_rng((seed, 67)).standard_normal((5, len(lenses)))
    lenses[:, 2] *= 1 + flaws.focal_spread * drawn[0]
    lenses[:, :2] += (flaws.centre_um * drawn[1:3] + flaws.moved_um * drawn[3:5]).T
    return element.model_copy(update={"lenses": tuple(map(tuple, lenses.tolist()))})


def _focal_scale(element: ElementSpec, wavelength_um: float) -> float:
    """Return the focal length in a wavelength over that of the layout: n - 1 follows Cauchy's two terms."""
    slope = 1 / (element.abbe * (LINE_F_UM**-2 - LINE_C_UM**-2))
    wanted, given = (1 + slope * (um**-2 - LINE_D_UM**-2) for um in (wavelength_um, element.focal_at_um))
    return given / wanted


def _samples(lens: _Lens, pitch_um: float, half_um: float) -> _Samples:
    """Return the samples of a cell of half width `half_um`: its spot fits into them, and none of its detail is lost.

    OPTICS.md 2.8: the samples of the sensor are fine enough for the fringes of the cell's width, and the square is wide
    enough for a spot out of focus.
    """
    light_um2 = lens.wavelength_um * lens.optics.diffuser_to_sensor_um
    steepest = float(np.linalg.norm(lens.curvature_per_um, 2)) * CORNER * half_um
    wide_um = WINDOW_UM + 2 * lens.optics.diffuser_to_sensor_um * steepest
    step = math.ceil(pitch_um * 4 * half_um / light_um2)
    pixels = fft.next_fast_len(math.ceil(wide_um / pitch_um))
    dx_um = light_um2 / (pixels * pitch_um)
    count = math.ceil(half_um / dx_um)
    return _Samples(np.arange(-count, count + 1, dtype=np.float64) * dx_um, dx_um, pixels, step)


def _cell(lens: _Lens, samples: _Samples) -> Floats:
    """Return the amplitude of a lens's cell: the part of the iris that is nearer to its vertex than to another's."""
    right_um, down_um = lens.centre_um
    cell = samples.disc(-right_um, -down_um, lens.optics.iris_um / 2)
    for other, (beside_um, below_um, _) in enumerate(lens.element.lenses):
        across, along = beside_um - right_um, below_um - down_um
        apart = math.hypot(across, along)
        if other != lens.number and apart < 4 * samples.x_um[-1]:
            towards_um = (samples.x_um[None, :] * across + samples.x_um[:, None] * along) / apart
            cell *= samples.edge(apart / 2 - towards_um)
    return cell


def _stops(lens: _Lens, samples: _Samples, beam: Beam | None) -> Floats | float:
    """Return the share of the amplitude that beam, and the lens's aperture or the gap around it, let through."""
    passed: Floats | float = 1.0
    if lens.element.aperture_um is not None:
        round_lens = samples.disc(0.0, 0.0, lens.element.aperture_um / 2)
        passed = 1 - round_lens if lens.is_gap else round_lens
    if beam is not None:
        right_um, down_um = lens.centre_um
        passed = passed * samples.disc(beam.x_um - right_um, beam.y_um - down_um, beam.radius_um)
    return passed


def _quadratic(form: Floats, x_um: Floats) -> Floats:
    """Return x^T form x on the square grid of the places `x_um`."""
    across, down = x_um[None, :], x_um[:, None]
    return np.asarray(form[0, 0] * across**2 + form[1, 1] * down**2 + 2 * form[0, 1] * across * down)


def _surface(samples: _Samples, cell: Floats, rng: np.random.Generator) -> Floats:
    """Return a random wavefront error of rms 1 over the cell: astigmatism, coma and spherical aberration."""
    radius_um = max(math.sqrt(float(cell.sum()) * samples.dx_um**2 / math.pi), samples.dx_um)
    u, v = samples.x_um[None, :] / radius_um, samples.x_um[:, None] / radius_um
    r2 = u**2 + v**2
    zernike = (u**2 - v**2, 2 * u * v, (3 * r2 - 2) * u, (3 * r2 - 2) * v, 6 * r2**2 - 6 * r2 + 1)
    norms = (6**0.5, 6**0.5, 8**0.5, 8**0.5, 5**0.5)
    error = sum(c * norm * z for c, norm, z in zip(rng.standard_normal(5), norms, zernike, strict=True))
    weights = cell / max(float(cell.sum()), 1e-30)
    error = error - (weights * error).sum()
    return np.asarray(error / max(math.sqrt(float((weights * error**2).sum())), 1e-30))


def _add_spot(psf: Floats, cell: Floats, waves: Floats, samples: _Samples, at_px: Floats) -> None:
    """Add the light of a cell to a PSF, in place, um^2: its spot lies at `at_px` (column, row)."""
    first_px = np.rint(at_px).astype(int) - samples.pixels // 2
    shift = (at_px - first_px + 0.5) * samples.step - 0.5  # of the spot in samples of the sensor
    count = samples.pixels * samples.step
    order = np.arange(len(cell)) / count
    across, down = (np.exp(2j * np.pi * by * order) for by in shift)
    field = (cell * np.exp(2j * np.pi * waves) * across[None, :] * down[:, None]).astype(np.complex64)
    spread = fft.fft2(field, (count, count), overwrite_x=True)
    grid = Grid(samples.pixels, samples.step, 1.0)
    spot = onto_pixels(spread.real**2 + spread.imag**2, grid) * float(cell.sum()) * samples.dx_um**2
    (left, top), size = first_px, len(psf)
    rows, cols = (slice(max(first, 0), min(first + samples.pixels, size)) for first in (top, left))
    psf[rows, cols] += spot[rows.start - top : rows.stop - top, cols.start - left : cols.stop - left]
