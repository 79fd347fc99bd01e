"""Parametric PSF of lenslets: place, light, focus and astigmatism of each spot, found in the image of a point source.

A lens images a point of the retina to a spot whose rays leave the cell of the lens. An eye moves each spot by its slope
and spreads it by the defocus of its own lens, so no PSF of another eye is stored (NUMERICS.md 7.11). Ray optics with
the diffraction of a round aperture and Hopkins' overlap; no code is shared with `device/optics`.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from device.values import Calibration, Geometry, Image, Mask, Psf

WAVELENGTH_UM = 0.55
WINDOW_UM = 300.0  # side of the square in which a spot is computed
FINEST_UM = 3.6  # samples of a spot: the diffraction of a lens of 600 um ends at a period of 5.5 um
FIT_PER_UM, FIT_NYQUIST = 0.09, 0.35  # highest frequency of a fit: per um, and cycles per pixel (aliasing)
NEAR_UM = 60.0  # radius around a spot within which its measured light is kept
SMOOTH_UM = 12.0  # of the image in which spots are searched: a spot 20 dioptres out of focus is 40 um wide
APART_UM = 150.0  # between two spots
LEAST_PEAK = 0.15  # of the brightest spot
MIN_SPOTS = 3  # fewer have no cells that show the iris
CHORDS, FINER = 53, 6  # along the iris, and places along a chord over the distance of two
STEPS = 4  # of the fit of each spot
DERIVATIVE = np.array([0.5, 0.5, 0.25, 0.25, 0.25])  # um and dpt
LARGEST_STEP = np.array([5.0, 5.0, 3.0, 3.0, 3.0])
GAP_LIGHT = 0.03  # share beside the spots from which on it is kept: 0.01 is diffracted there

Floats = NDArray[np.float64]
Spectrum = NDArray[np.complex128]
Eye = tuple[float, float, float]
EMMETROPIA: Eye = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Spots:
    """Spots of a PSF by place, light and focus.

    Attributes
    ----------
    psf
        Image of the point source.
    geometry
        Geometry of the head.
    places_um
        Centre of each spot, right and down of the axis, (spots, 2).
    light
        Share of the light of the PSF in each spot, (spots,).
    focus_dpt
        M, J0 and J45 of the eye for which its lens is in focus on the sensor, (spots, 3).
    centroids_um
        Centroid of the cell of its lens on the iris, (spots, 2).
    cells_um
        Cell around this centroid, as chords (chords, 3): middle (right, down) and length.
    chord_um
        Distance of two chords.
    misfit
        Relative rms error of the spots' spectra.
    """

    psf: Psf
    geometry: Geometry
    places_um: Floats
    light: Floats
    focus_dpt: Floats
    centroids_um: Floats
    cells_um: tuple[Floats, ...]
    chord_um: float
    misfit: float

    @property
    def beside(self) -> float:
        """Share of the light that is beside the spots: of clear gaps, scatter, and an uneven pedestal."""
        return 1 - float(self.light.sum())

    @property
    def lens_um(self) -> float:
        """Diameter of a disc of the mean area of the cells, um."""
        areas_um2 = [cell[:, 2].sum() * self.chord_um for cell in self.cells_um]
        return float(np.sqrt(4 / np.pi * np.mean(areas_um2)))

    def of_eye(self, eye: Eye, field_deg: float = 0.0) -> Psf:
        """Return the PSF of an eye, mean over a field of view at whose places the lenses have other foci.

        Near a spot it is the model plus what was measured beside it, which moves with the spot and falls to 1/e when
        the wavefront at the corner of the cell changes by a quarter of a wavelength. Elsewhere it is the model, with
        the light that was measured there if that is more than GAP_LIGHT.

        Parameters
        ----------
        eye
            M, J0 and J45 in dpt; M > 0: myopia.
        field_deg
            Diameter of the field; 0: the axis.

        Returns
        -------
        Psf
            With the rows and columns of the calibrated PSF.
        """
        pitch_um, shape = self.geometry.pitch_um, self.psf.shape
        calibrated, pixels = np.zeros(shape), np.zeros(shape)
        near = np.zeros(shape)
        moved_um = self.centroids_um @ power_matrix(np.array(eye)) * self.geometry.scale_per_dpt
        excess_dpt = self.geometry.lens_excess_dpt(field_deg)
        for number, place_um in enumerate(self.places_um):
            before, after = _Patch(shape, pitch_um, place_um), _Patch(shape, pitch_um, place_um - moved_um[number])
            known = self._calibrated[number]
            rest = np.where(before.near, before.of(self.psf.pixels) - known, 0)
            rest = ndimage.shift(rest, (after.off_um - before.off_um)[::-1] / pitch_um, order=3)
            model = self._model(number, self.mean_spectrum(number, eye, field_deg, after.right, after.down), after)
            after.add(model + self._kept(number, np.array(eye) + excess_dpt) * rest, pixels)
            before.add(known, calibrated)
            before.add(before.near, near)
        if self.beside > GAP_LIGHT:
            pixels += np.where(near > 0, 0, self.psf.pixels - calibrated)
        return Psf(pixels.astype(np.float32), self.psf.name, self.psf.colour)

    def _kept(self, number: int, eyes: Floats) -> float:
        """Return the share of a spot's rest that these eyes, (eyes, 3), have in common with that of the calibration."""
        per_dpt = 1e-6 * self.geometry.angular_magnification**2 * _corner_um(self.cells_um[number]) ** 2
        waves = [np.linalg.norm(power_matrix(eye), 2) * per_dpt / (2 * WAVELENGTH_UM) for eye in eyes]
        return float(np.exp(-np.square(4 * np.array(waves))).mean())

    @cached_property
    def _calibrated(self) -> list[Floats]:
        """Model of each spot for the eye of the calibration."""
        shape, pitch_um = self.psf.shape, self.geometry.pitch_um
        patches = [_Patch(shape, pitch_um, place_um) for place_um in self.places_um]
        return [
            self._model(number, self.spectrum(number, self.focus_dpt[number], patch.right, patch.down), patch)
            for number, patch in enumerate(patches)
        ]

    def _model(self, number: int, spectrum: Spectrum, patch: "_Patch") -> Floats:
        return patch.image(self.light[number] * spectrum)

    def mean_spectrum(self, number: int, eye: Eye, field_deg: float, right: Floats, down: Floats) -> Spectrum:
        """Return the transfer of a spot behind an eye around its centre on the axis, mean over a field of view.

        A lens with another focus displaces its spot by the distance of its cell's centroid from its own centre.

        Parameters
        ----------
        number
            Index of the spot.
        eye
            M, J0 and J45 in dpt.
        field_deg
            Diameter of the field; 0: the axis.
        right
            Frequencies along the columns, per um.
        down
            Frequencies along the rows, per um, of the same shape.

        Returns
        -------
        Spectrum
            Complex, of that shape.
        """
        scale, drawn_dpt = self.geometry.scale_per_dpt, self.geometry.lens_focus_dpt or 0.0
        off_um = (self.centroids_um[number] - self.places_um[number]) / (1 - scale * drawn_dpt)
        spectra = []
        for excess_dpt in self.geometry.lens_excess_dpt(field_deg):
            moved_um = -scale * power_matrix(excess_dpt) @ off_um
            turn = np.exp(-2j * np.pi * (right * moved_um[0] + down * moved_um[1]))
            spectra.append(turn * self.spectrum(number, self.focus_dpt[number] - eye - excess_dpt, right, down))
        return np.asarray(np.mean(spectra, axis=0))

    def spectrum(self, number: int, focus_dpt: Floats, right: Floats, down: Floats) -> Spectrum:
        """Return the transfer of a spot around its centre.

        NUMERICS.md 7.11.

        Parameters
        ----------
        number
            Index of the spot.
        focus_dpt
            M, J0 and J45 of its defocus, (3,).
        right
            Frequencies along the columns, per um.
        down
            Frequencies along the rows, per um, of the same shape.

        Returns
        -------
        Spectrum
            Complex, of that shape; 1 at frequency 0.
        """
        right_um, down_um, long_um = self.cells_um[number].T
        wide_um = np.sqrt(4 / np.pi * long_um.sum() * self.chord_um)
        radius = np.hypot(right, down)
        apart = np.clip(WAVELENGTH_UM * self.geometry.diffuser_to_sensor_um * radius / wide_um, 0, 1)
        diffraction = 2 / np.pi * (np.arccos(apart) - apart * np.sqrt(1 - apart**2))
        spread = power_matrix(focus_dpt) * self.geometry.scale_per_dpt
        across, along = np.moveaxis(np.stack([right, down], axis=-1) * (1 - apart)[..., None] @ spread, -1, 0)[
            ..., None
        ]
        turns = (across * right_um + along * down_um).astype(np.float32)
        rays = np.exp(np.complex64(-2j * np.pi) * turns) * np.sinc(across * long_um)
        return np.asarray(diffraction * (rays @ (long_um / long_um.sum())))


class _Patch:
    """Square of pixels around a spot, with the frequencies of its finer samples."""

    def __init__(self, shape: tuple[int, int], pitch_um: float, place_um: Floats) -> None:
        self._pitch_um = pitch_um
        self.size = 2 * round(WINDOW_UM / pitch_um / 2)
        self.finer = int(np.ceil(pitch_um / FINEST_UM))
        middle = np.rint(place_um / pitch_um).astype(int)
        self.off_um = place_um - middle * pitch_um
        left, top = middle + np.array(shape)[::-1] // 2 - self.size // 2
        self._rows, self._cols = slice(max(top, 0), top + self.size), slice(max(left, 0), left + self.size)
        self._inside = (
            slice(max(-top, 0), max(min(self.size, shape[0] - top), 0)),
            slice(max(-left, 0), max(min(self.size, shape[1] - left), 0)),
        )
        count = self.size * self.finer
        self.right, self.down = np.meshgrid(
            fft.rfftfreq(count, pitch_um / self.finer), fft.fftfreq(count, pitch_um / self.finer)
        )

    @property
    def near(self) -> Mask:
        """Pixels within NEAR_UM of the spot."""
        along = (np.arange(self.size) - self.size // 2) * self._pitch_um
        return np.asarray(np.hypot(along[None] - self.off_um[0], along[:, None] - self.off_um[1]) < NEAR_UM)

    def of(self, pixels: Image) -> Floats:
        """Return the image within this patch; 0 beyond the image."""
        square = np.zeros((self.size, self.size))
        square[self._inside] = pixels[self._rows, self._cols]
        return square

    def add(self, square: Floats | Mask, pixels: Floats) -> None:
        """Add the pixels of this patch to an image, in place."""
        pixels[self._rows, self._cols] += square[self._inside]

    def image(self, spectrum: Spectrum) -> Floats:
        """Return the pixels of a spot with this spectrum."""
        count, pitch_um = self.size * self.finer, self._pitch_um
        at_um = self.off_um + self.size // 2 * pitch_um
        turned = spectrum * np.exp(-2j * np.pi * (self.right * at_um[0] + self.down * at_um[1]))
        turned *= np.sinc(self.right * pitch_um) * np.sinc(self.down * pitch_um)
        return np.asarray(fft.irfft2(turned, (count, count))[:: self.finer, :: self.finer] * self.finer**2)


@lru_cache(maxsize=4)  # each holds its PSF
def find_spots(psf: Psf, geometry: Geometry) -> Spots | None:
    """Return the spots of a PSF; None behind a diffuser, and for fewer than MIN_SPOTS."""
    pitch_um = geometry.pitch_um
    if geometry.lens_focus_dpt is None:
        return None
    places_um, light = _seen_spots(psf, pitch_um)
    if len(places_um) < MIN_SPOTS:
        return None
    centroids_um, cells_um, chord_um = _cells(places_um, light)
    focus_dpt = np.tile([geometry.lens_focus_dpt, 0.0, 0.0], (len(light), 1))
    first = Spots(psf, geometry, places_um, light, focus_dpt, centroids_um, cells_um, chord_um, 0.0)
    fits = [_SpotFit(first, number) for number in range(len(light))]
    found = [fit.best(np.array([0.0, 0.0, *focus])) for fit, focus in zip(fits, focus_dpt, strict=True)]
    misfit = float(np.sqrt(np.mean([fit.misfit(values) for fit, (values, _) in zip(fits, found, strict=True)])))
    values = np.array([values for values, _ in found])
    shares = np.array([share for _, share in found])
    return Spots(
        psf, geometry, places_um + values[:, :2], shares, values[:, 2:], centroids_um, cells_um, chord_um, misfit
    )


def without_noise(calibration: Calibration) -> Calibration:
    """Return the calibration with the PSFs of lenslets without the noise between the spots; any other as it is.

    Light beside the spots stays if it is more than GAP_LIGHT.
    """
    geometry = calibration.geometry
    if geometry is None or geometry.lens_focus_dpt is None:
        return calibration
    spots = [find_spots(psf, geometry) for psf in calibration.psfs]
    clean = [
        psf if found is None else found.of_eye(EMMETROPIA) for psf, found in zip(calibration.psfs, spots, strict=True)
    ]
    return replace(calibration, psfs=tuple(clean))


class _SpotFit:
    """Fit of one spot to the spectrum of the light around it, by shift (um) and focus (dpt); its light is linear."""

    def __init__(self, spots: Spots, number: int) -> None:
        pitch_um = spots.geometry.pitch_um
        patch = _Patch(spots.psf.shape, pitch_um, spots.places_um[number])
        fine = fft.fftfreq(patch.size, pitch_um)
        right, down = np.meshgrid(fft.rfftfreq(patch.size, pitch_um), fine)
        within = np.hypot(right, down) < min(FIT_PER_UM, FIT_NYQUIST / pitch_um)
        self._right, self._down = right[within], down[within]
        self._spots, self._number, self._off_um = spots, number, patch.off_um
        self._pixel = np.sinc(self._right * pitch_um) * np.sinc(self._down * pitch_um)
        light = fft.rfft2(np.where(patch.near, patch.of(spots.psf.pixels), 0))[within]
        at_um = patch.size // 2 * pitch_um
        self._seen = light * np.exp(2j * np.pi * at_um * (self._right + self._down))

    def _model(self, values: Floats) -> Spectrum:
        """Return the spectrum of a spot of unit light."""
        at_um = self._off_um + values[:2]
        spectrum = self._spots.spectrum(self._number, values[2:], self._right, self._down)
        turn = np.exp(-2j * np.pi * (self._right * at_um[0] + self._down * at_um[1]))
        return np.asarray(spectrum * self._pixel * turn)

    def _fitted(self, values: Floats) -> tuple[Spectrum, float]:
        model = self._model(values)
        return model, float(np.vdot(model, self._seen).real / np.vdot(model, model).real)

    def misfit(self, values: Floats) -> float:
        """Return the squared error over the squared spectrum."""
        model, light = self._fitted(values)
        return float((np.abs(self._seen - light * model) ** 2).sum() / (np.abs(self._seen) ** 2).sum())

    def best(self, start: Floats) -> tuple[Floats, float]:
        """Return shift and focus by Gauss-Newton steps from `start` on, and the light."""
        values = start
        for _ in range(STEPS):
            model, light = self._fitted(values)
            slopes = [light * (self._model(values + axis) - model) / axis.max() for axis in np.diag(DERIVATIVE)]
            columns = np.array([*slopes, model])
            rest = self._seen - light * model
            matrix = np.vstack([columns.real.T, columns.imag.T])
            step = np.linalg.lstsq(matrix, np.concatenate([rest.real, rest.imag]), rcond=1e-3)[0][:5]
            tried = values + np.clip(step, -LARGEST_STEP, LARGEST_STEP)
            if self.misfit(tried) >= self.misfit(values):
                break
            values = tried
        return values, self._fitted(values)[1]


def _seen_spots(psf: Psf, pitch_um: float) -> tuple[Floats, Floats]:
    """Return centroid (right, down), um, and light of each spot that stands out of the smoothed image."""
    smooth = ndimage.gaussian_filter(psf.pixels, SMOOTH_UM / pitch_um, truncate=3)
    wide = 2 * max(round(APART_UM / pitch_um / 2), 1) + 1
    is_peak = (smooth == ndimage.maximum_filter(smooth, wide)) & (smooth > LEAST_PEAK * smooth.max())
    rows, cols = np.nonzero(is_peak)
    places, light = [], []
    for row, col in zip(rows, cols, strict=True):
        place_um = (np.array([col, row]) - (psf.shape[1] // 2, psf.shape[0] // 2)) * pitch_um
        patch = _Patch(psf.shape, pitch_um, place_um)
        square = np.where(patch.near, patch.of(psf.pixels), 0)
        along = (np.arange(patch.size) - patch.size // 2) * pitch_um
        total = max(float(square.sum()), 1e-30)
        places.append(place_um + np.array([square.sum(0) @ along, square.sum(1) @ along]) / total)
        light.append(total)
    return np.array(places).reshape(-1, 2), np.array(light)


def _cells(places_um: Floats, light: Floats) -> tuple[Floats, tuple[Floats, ...], float]:
    """Return the centroid of the cell of each spot's lens, its chords around it, and the distance of chords, um.

    Each place of the iris belongs to the nearest spot. Of 29 radii of the iris that one is taken for which the areas of
    the cells fit the light of the spots best; lenses at the rim may have their centres beyond it.
    """
    reach_um = float(np.hypot(*places_um.T).max())
    nearest_um = np.sort(np.hypot(*(places_um[:, None] - places_um[None]).transpose(2, 0, 1)), axis=1)[:, 1]
    fits = []
    for radius_um in reach_um + float(np.median(nearest_um)) * np.linspace(-0.5, 0.9, 29):
        areas = np.array([cell[:, 2].sum() for cell in _chords(places_um, radius_um)[0]])
        fits.append((float(np.square(areas / areas.sum() - light / light.sum()).sum()), float(radius_um)))
    cells, chord_um = _chords(places_um, min(fits)[1])
    centroids = np.array([cell[:, 2] @ cell[:, :2] / cell[:, 2].sum() for cell in cells])
    return centroids, tuple(cell - (*at, 0) for cell, at in zip(cells, centroids, strict=True)), chord_um


def _chords(places_um: Floats, radius_um: float) -> tuple[list[Floats], float]:
    """Return chords (middle right and down, length; um) of the iris nearest to each place, and their distance."""
    step_um = 2 * radius_um / CHORDS
    rows_um = (np.arange(CHORDS) + 0.5) * step_um - radius_um
    cols_um = (np.arange(CHORDS * FINER) + 0.5) * step_um / FINER - radius_um
    right, down = np.meshgrid(cols_um, rows_um)
    owners = np.stack([(right - x) ** 2 + (down - y) ** 2 for x, y in places_um]).argmin(axis=0)
    owners[np.hypot(right, down) > radius_um] = -1
    cells = []
    for number in range(len(places_um)):
        own = owners == number
        counts = own.sum(axis=1)
        crossed = counts > 0
        middles_um = (own @ cols_um)[crossed] / counts[crossed]
        cells.append(np.stack([middles_um, rows_um[crossed], counts[crossed] * step_um / FINER], axis=1))
    return cells, step_um


def _corner_um(cell_um: Floats) -> float:
    """Return the distance of the farthest place of a cell from its centroid."""
    return float(np.hypot(np.abs(cell_um[:, 0]) + cell_um[:, 2] / 2, cell_um[:, 1]).max())


def power_matrix(focus_dpt: Floats) -> Floats:
    """Return M, J0 and J45 as the power matrix."""
    m_dpt, j0_dpt, j45_dpt = focus_dpt
    return np.array([[m_dpt + j0_dpt, j45_dpt], [j45_dpt, m_dpt - j0_dpt]])
