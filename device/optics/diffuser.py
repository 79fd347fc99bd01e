"""Diffuser at the iris: a smooth random surface, and the wave-optics PSF of a retinal point behind it.

    opd_sigma_um   roughness of the surface, from the scattering angle in its data sheet
    surface        one realisation of the surface
    caustic        point spread function on the sensor (paper, section "Algorithm": h)

x runs with the columns and y with the rows; the axis of the eye meets the sensor in the middle of pixel (n//2, n//2).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from device.config.head_file import OpticsSpec
from device.errors import SpecError
from device.optics.propagation import Field, propagate, require_sampling
from device.values import Image

FWHM_PER_SIGMA = 2.3548
MAX_SLOPE_SIGMAS = 5  # light at slopes beyond five sigma is below one count (OPTICS.md 2.4: f_max ~ 5 sigma/lambda)
SAMPLING_FRACTION = (
    0.4  # of the coarsest permitted sampling: the PSF is then within 1 % of one on half that pitch (2.2)
)
WINDOW_MARGIN = 1.2  # window / extent of the light, so that light diffracted at the iris does not wrap around
IRIS_EDGE_UM = 10.0  # width of the iris's soft edge
MAX_SAMPLES = 4096


class Beam(NamedTuple):
    """Circular beam of one place of the retina at the iris: shift of its centre from the iris's, and its radius."""

    x_um: float
    y_um: float
    radius_um: float


class Refraction(NamedTuple):
    """Refraction of an eye as a wavefront: mean sphere M and cylinder components J0 and J45, in dioptres.

    Positive M: the beam that leaves the eye converges (myopia). The correction at the pupil is -M.
    """

    m_dpt: float = 0.0
    j0_dpt: float = 0.0
    j45_dpt: float = 0.0

    def warp(self, optics: OpticsSpec) -> NDArray[np.float64]:
        """Return the (2, 2) matrix that maps (x, y) in the caustic of an emmetropic eye to that of this eye.

        OPTICS.md 2.6.
        """
        m, j0, j45 = self
        lever = optics.diffuser_to_sensor_um * 1e-6 * optics.angular_magnification**2
        return np.eye(2) - lever * np.array([[m + j0, j45], [j45, m - j0]])


EMMETROPIA = Refraction()


@dataclass(frozen=True)
class Grid:
    """Square grid for wave optics: `pixels` x `pixels` sensor pixels of `pitch_um`, each of `step` x `step` samples."""

    pixels: int
    step: int
    pitch_um: float

    @property
    def samples(self) -> int:
        """Samples along one side."""
        return self.pixels * self.step

    @property
    def dx_um(self) -> float:
        """Distance between samples, um."""
        return self.pitch_um / self.step

    @property
    def x_um(self) -> NDArray[np.float64]:
        """Positions of the samples, um; zero is the middle of pixel `pixels // 2`."""
        middle = self.pixels // 2 * self.step + (self.step - 1) / 2
        return (np.arange(self.samples, dtype=np.float64) - middle) * self.dx_um


def slope_sigma(optics: OpticsSpec) -> float:
    """Return the standard deviation of the optical slope along one axis, radians."""
    return math.radians(optics.element.slope_fwhm_deg) / FWHM_PER_SIGMA


def opd_sigma_um(optics: OpticsSpec) -> float:
    """Return the standard deviation of the optical path difference, um; OPTICS.md 2.1: sigma_th * ell / sqrt(2)."""
    return slope_sigma(optics) * optics.element.correlation_um / math.sqrt(2)


def steepest_rad(optics: OpticsSpec, refraction: Refraction = EMMETROPIA) -> float:
    """Return the steepest ray behind the diffuser, rad: five sigma of its slope, plus the eye's slope at the iris."""
    m, j0, j45 = refraction
    eye = optics.angular_magnification**2 * (abs(m) + math.hypot(j0, j45)) * optics.iris_um / 2 * 1e-6
    return MAX_SLOPE_SIGMAS * slope_sigma(optics) + eye


def grid_for(optics: OpticsSpec, pitch_um: float, refraction: Refraction = EMMETROPIA) -> Grid:
    """Return a grid, as small as possible, whose samples are a whole fraction of a pixel and resolve the caustic.

    SpecError if that needs more than 4096 samples a side, or if the correlation length exceeds a quarter of the grid.
    """
    angle = steepest_rad(optics, refraction)
    coarsest_um = min(SAMPLING_FRACTION * optics.wavelength_um / (2 * angle), optics.element.correlation_um / 4)
    step = math.ceil(pitch_um / coarsest_um)
    extent_um = WINDOW_MARGIN * (optics.iris_um + 2 * optics.diffuser_to_sensor_um * angle)
    fringes_um = optics.wavelength_um * optics.diffuser_to_sensor_um * step / pitch_um
    needed = math.ceil(max(extent_um, fringes_um) / pitch_um)
    if needed * step > MAX_SAMPLES:
        raise SpecError(
            f"the caustic of this diffuser needs {needed * step} samples a side, more than {MAX_SAMPLES}",
            "Choose a smaller slope, iris or distance, or a longer correlation of the diffuser.",
        )
    grid = Grid(fft.next_fast_len(needed, real=True), step, pitch_um)
    if optics.element.correlation_um > grid.pixels * pitch_um / 4:
        raise SpecError(
            f"a surface that is correlated over {optics.element.correlation_um:g} um is no diffuser in this iris"
        )
    return grid


def surface(optics: OpticsSpec, grid: Grid, seed: int) -> Image:
    """Return the optical path difference of one diffuser, um: Gaussian, zero mean, autocorrelation exp(-r^2 / ell^2).

    float32 (samples, samples). The same seed and window size give the same surface at any sampling, because the random
    numbers are the amplitudes of the surface's spatial frequencies and not its samples.
    """
    window_um = grid.samples * grid.dx_um
    ell_um = optics.element.correlation_um
    waves = min(math.ceil(window_um * 1.7 / ell_um), (grid.samples - 1) // 2)  # beyond: below 1e-6 of the longest
    order = np.arange(-waves, waves + 1)
    f_squared = (order[:, None] ** 2 + order[None, :] ** 2) / window_um**2
    draw = np.random.default_rng(seed).standard_normal((2, order.size, order.size))
    spectrum = np.zeros((grid.samples, grid.samples), np.complex64)
    waves_there = (draw[0] + 1j * draw[1]) * np.exp(-((np.pi * ell_um) ** 2) * f_squared / 2)
    start = np.exp(2j * np.pi * order * grid.x_um[0] / window_um)  # the axis, not a corner, is the phase origin
    spectrum[np.ix_(order, order)] = waves_there * start[:, None] * start[None, :]
    spectrum[0, 0] = 0
    opd: Image = fft.ifft2(spectrum, overwrite_x=True).real.astype(np.float32)
    opd *= opd_sigma_um(optics) / float(opd.std())
    return opd


def caustic(
    optics: OpticsSpec,
    pitch_um: float,
    seed: int,
    refraction: Refraction = EMMETROPIA,
    lines: int = 3,
    beam: Beam | None = None,
) -> Image:
    """Return the intensity on the sensor from one retinal point on the axis by wave optics: float32 (n, n), sum 1.

    With a `beam` that does not fill the iris, the sum is the transmitted share, below 1. `seed` selects the diffuser.
    `lines` wavelengths across the bandwidth add incoherently. Every pixel integrates over its whole area. The grid is
    that of a relaxed eye, because another window would hold another surface. SpecError if no grid samples the light
    sufficiently, or if the grid cannot carry so strong a refraction. OPTICS.md 2.2.
    """
    return caustic_on(grid_for(optics, pitch_um), optics, seed, refraction, lines, beam)


def caustic_on(
    grid: Grid,
    optics: OpticsSpec,
    seed: int,
    refraction: Refraction = EMMETROPIA,
    lines: int = 3,
    beam: Beam | None = None,
) -> Image:
    """Return the result of `caustic` on a given grid, (pixels, pixels); SpecError for a grid too coarse or small."""
    require_sampling(
        grid.samples,
        grid.dx_um,
        wavelength_um=optics.wavelength_um,
        distance_um=optics.diffuser_to_sensor_um,
        aperture_um=optics.iris_um,
        angle_rad=steepest_rad(optics, refraction),
    )
    path_um = surface(optics, grid, seed) + eye_wavefront_um(optics, grid, refraction)
    amplitude = iris(optics, grid)
    passed = 1.0
    if beam is not None:
        covered = amplitude * _disc(grid, beam)
        passed = float((covered**2).sum(dtype=np.float64) / (amplitude**2).sum(dtype=np.float64))
        amplitude = covered
    intensity = np.zeros_like(amplitude)
    for wavelength_um in spectral_lines_um(optics, lines):
        field: Field = amplitude * np.exp(np.complex64(2j * np.pi / wavelength_um) * path_um)
        carried = propagate(field, grid.dx_um, wavelength_um, optics.diffuser_to_sensor_um)
        intensity += carried.real**2 + carried.imag**2
    return onto_pixels(intensity, grid) * np.float32(passed)


def spectral_lines_um(optics: OpticsSpec, lines: int) -> list[float]:
    """Return the central wavelengths of `lines` equal slices of the bandwidth, um."""
    return [optics.wavelength_um + optics.bandwidth_um * ((i + 0.5) / lines - 0.5) for i in range(lines)]


def iris(optics: OpticsSpec, grid: Grid) -> Image:
    """Return the amplitude transmission of the circular iris, with an edge 10 um soft; float32 (samples, samples)."""
    return _disc(grid, Beam(0.0, 0.0, optics.iris_um / 2))


def _disc(grid: Grid, beam: Beam) -> Image:
    """Return the amplitude of a circular beam, 0 to 1, float32 (samples, samples), with an edge 10 um soft."""
    x_um = grid.x_um.astype(np.float32)
    radius_um = np.hypot(x_um[:, None] - np.float32(beam.y_um), x_um[None, :] - np.float32(beam.x_um))
    amplitude: Image = np.clip((beam.radius_um - radius_um) / IRIS_EDGE_UM + 0.5, 0, 1)
    return amplitude


def eye_wavefront_um(optics: OpticsSpec, grid: Grid, refraction: Refraction) -> Image:
    """Return the optical path difference of a refractive error over the iris, um; OPTICS.md 2.2, W."""
    m, j0, j45 = refraction
    x_um = grid.x_um[None, :]
    y_um = grid.x_um[:, None]
    form = m * (x_um**2 + y_um**2) + j0 * (x_um**2 - y_um**2) + 2 * j45 * x_um * y_um
    wavefront: Image = (-0.5e-6 * optics.angular_magnification**2 * form).astype(np.float32)
    return wavefront


def onto_pixels(intensity: Image, grid: Grid) -> Image:
    """Return the intensity on the pixels, (pixels, pixels), sum 1: exact average over each sample, then block sum."""
    f_rows = fft.fftfreq(grid.samples)
    f_cols = fft.rfftfreq(grid.samples)
    spectrum = fft.rfft2(intensity)
    spectrum *= np.sinc(f_rows)[:, None].astype(np.float32)
    spectrum *= np.sinc(f_cols)[None, :].astype(np.float32)
    smooth = fft.irfft2(spectrum, s=intensity.shape, overwrite_x=True)
    blocks = smooth.reshape(grid.pixels, grid.step, grid.pixels, grid.step).sum((1, 3))
    np.maximum(blocks, 0, out=blocks)
    psf: Image = (blocks / max(blocks.sum(dtype=np.float64), 1e-30)).astype(np.float32)
    return psf
