"""Pupil that hides part of the diffuser: the disc of the stored PSF that explains a frame; NUMERICS.md 7.10.

Behind a weak diffuser a place in the PSF is lit by the same place of the diffuser, up to the blur by its slopes, and a
spot of lenslets by its lens. The PSF behind a small or decentred pupil is therefore the stored one times a soft disc,
the image of the pupil. The disc is searched on a coarse grid by the likelihood of the spectrum (`likelihood`), and then
refined with the eye by Gauss-Newton steps on the likelihood of the frame (`crop_model`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft
from scipy.special import ndtr

from device.recon.estimation.psf_warp import Transform
from device.recon.estimation.refraction.crop_model import CropModel, Fit
from device.recon.estimation.refraction.edge import EdgeLikelihood
from device.recon.estimation.refraction.likelihood import SampledFrame, band_likelihood, noise_power
from device.recon.model.fft_plans import Planner, Spectrum
from device.recon.model.grid import Grid
from device.recon.model.kernels import Pixels, Places
from device.values import Image, Psf

SOFT_UM = 22.0  # sd of the disc's edge: slope of the diffuser (0.5 degrees FWHM) times 6 mm to the sensor
DIRECTIONS = 12
EDGES = (0.82, 0.65, 0.47, 0.29, 0.12)  # of the PSF's radius: nearest place of the edge in the coarse search
LARGE = 2.5  # radius of these discs, in radii of the PSF
CENTRED = (0.82, 0.7, 0.59, 0.47)  # radii of the centred discs
MAX_STEPS = 9
DISC_STEPS = 2  # first steps, of the disc only
COVARIANCE_STEPS = (0, 4)
LARGEST_STEP_UM, LARGEST_STEP_DPT = 300.0, 0.3
SETTLED_UM, SETTLED_DPT = 3.0, 0.03
MIN_RADIUS_UM = 400.0
DERIVATIVE_STEP_UM, DERIVATIVE_STEP_DPT = 5.0, 0.05
RIM, OUTSIDE = (0.87, 0.99), 1.06  # of the PSF's radius

Floats = NDArray[np.float64]


class Pupil(NamedTuple):
    """Image of a pupil on the element, a disc relative to the centre of the PSF with the sd of its edge, in um."""

    right_um: float
    down_um: float
    radius_um: float
    soft_um: float = SOFT_UM

    def moved(self, by_um: Floats) -> "Pupil":
        """Return the disc with its centre (right, down) moved and its radius larger by three distances, um."""
        right_um, down_um, larger_um = by_um.tolist()
        return Pupil(self.right_um + right_um, self.down_um + down_um, self.radius_um + larger_um, self.soft_um)

    @property
    def nearest_um(self) -> float:
        """Distance of the nearest place of its edge from the centre of the PSF, negative beyond it."""
        return self.radius_um - float(np.hypot(self.right_um, self.down_um))

    def passed(self, right_um: Floats, down_um: Floats) -> Floats:
        """Return the share of the light, 0 to 1, that reaches places of the PSF, relative to its centre in um."""
        inward_um = self.radius_um - np.hypot(right_um - self.right_um, down_um - self.down_um)
        return np.asarray(ndtr(inward_um / self.soft_um))

    def hide(self, psf: Psf, pitch_um: float) -> tuple[Psf, float]:
        """Return the PSF behind the pupil, with the sum of `psf`, and the share of the light that is hidden."""
        rows, cols = ((np.arange(size, dtype=np.float64) - size // 2) * pitch_um for size in psf.shape)
        pixels = psf.pixels * self.passed(cols[None], rows[:, None])
        whole, left = float(psf.pixels.sum(dtype=np.float64)), float(pixels.sum(dtype=np.float64))
        return Psf(np.asarray(pixels * (whole / left), np.float32), psf.name), 1 - left / whole


class PupilModel(CropModel):
    """Model of a frame around an eye behind a pupil; the derivatives are those of M, J0, J45 and of the disc.

    `pupil` is that of the next `focus`.
    """

    def __init__(self, edges: EdgeLikelihood, planner: Planner, psf_radius_px: float, pupil: Pupil) -> None:
        super().__init__(edges, planner, psf_radius_px)
        self.pupil = pupil

    def focus(self, eye_dpt: Floats) -> None:
        """Set OTF, its derivatives and the preconditioner to an eye behind the pupil."""
        pairs = [(eye_dpt + step, eye_dpt - step, self.pupil, self.pupil) for step in np.eye(3) * DERIVATIVE_STEP_DPT]
        for step_um in np.eye(3) * DERIVATIVE_STEP_UM:
            above, below = (self.pupil.moved(sign * step_um) for sign in (1, -1))
            pairs.append((eye_dpt, eye_dpt, above, below))
        changes = [self._behind(eye, disc) - self._behind(other, less) for eye, other, disc, less in pairs]
        steps = (DERIVATIVE_STEP_DPT,) * 3 + (DERIVATIVE_STEP_UM,) * 3
        slopes = [change / np.float32(2 * step) for change, step in zip(changes, steps, strict=True)]
        self._focus_on(self._behind(eye_dpt, self.pupil), slopes)

    def _behind(self, eye_dpt: Floats, pupil: Pupil) -> Spectrum:
        return otf_behind(self._edges, eye_dpt, pupil)


def otf_behind(edges: EdgeLikelihood, eye_dpt: Floats, pupil: Pupil | None) -> Spectrum:
    """Return the OTF of an eye (M, J0, J45) behind a pupil, on the grid of `edges`; None: the whole PSF."""
    likelihood, grid = edges.likelihood, edges.grid
    stretch = likelihood.stretch(*eye_dpt)
    otf = likelihood.interpolated_otf.on_grid(grid.shape, grid.n, stretch)
    if pupil is None:
        return otf
    psf = scipy_fft.irfft2(otf, grid.shape)
    psf *= pupil.passed(*_places_um(grid, likelihood.geometry.pitch_um, stretch))
    return np.asarray(scipy_fft.rfft2(psf) / psf.sum(dtype=np.float64), np.complex64)


def _places_um(grid: Grid, pitch_um: float, stretch: Transform) -> tuple[Floats, Floats]:
    """Return the places (right, down) of the samples of a stretched PSF on the torus, before the stretch."""
    back = np.linalg.inv(stretch)
    rows, cols = (np.fft.fftfreq(size, 1 / size).astype(np.float64) * (pitch_um * grid.n) for size in grid.shape)
    down, right = rows[:, None], cols[None]
    return back[0, 0] * right + back[0, 1] * down, back[1, 0] * right + back[1, 1] * down


class PupilFinder:
    """Finder of the pupil in the frames of an `EdgeLikelihood`.

    `psf_radius_px`: of the PSF; `soft_um`: sd of the edge of a pupil's image in it.
    """

    def __init__(self, edges: EdgeLikelihood, planner: Planner, psf_radius_px: float, soft_um: float = SOFT_UM) -> None:
        self._edges, self._soft_um = edges, soft_um
        self._radius_um = psf_radius_px * edges.likelihood.geometry.pitch_um
        self._model = PupilModel(edges, planner, psf_radius_px, Pupil(0.0, 0.0, self._radius_um))

    def __call__(self, counts: Pixels, dark: Pixels | None, defects: Places | None, m_dpt: float) -> Pupil | None:
        """Return the pupil that explains a frame, from the mean sphere M of the whole PSF on.

        None if no disc explains the spectrum better than the whole PSF, or if a disc and an eye are not found.
        """
        eye_dpt = np.array([m_dpt, 0.0, 0.0])
        self._edges.start(counts, dark, defects)
        self._edges.fit_smooth(eye_dpt)
        self._edges.set_noise(eye_dpt)
        nats = _SpectrumLikelihood(self._edges, self._edges.likelihood.frame(counts, dark, defects), eye_dpt)
        best = min(self._candidates(), key=nats)
        if nats(best) >= nats(None):
            return None
        try:
            return self._refined(best, eye_dpt)
        except np.linalg.LinAlgError:  # a disc that determines nothing
            return None

    def _candidates(self) -> list[Pupil]:
        radius_um = self._radius_um
        found = [Pupil(0.0, 0.0, share * radius_um, self._soft_um) for share in CENTRED]
        for turn in 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
            for share in EDGES:
                away_um = (LARGE - share) * radius_um
                right_um, down_um = away_um * np.cos(turn), away_um * np.sin(turn)
                found.append(Pupil(right_um, down_um, LARGE * radius_um, self._soft_um))
        return found

    def _refined(self, pupil: Pupil, eye_dpt: Floats) -> Pupil | None:
        """Return the pupil after Gauss-Newton steps, first of the disc alone, as M is that of the whole PSF."""
        model, light = self._model, self._edges.frame.y
        model.start(eye_dpt)
        detail = None
        for done in range(MAX_STEPS):
            model.pupil = pupil
            model.focus(eye_dpt)
            fit = model.fit(light, detail)
            detail = fit.detail
            if done in COVARIANCE_STEPS:
                covariance = model.covariance(fit.derivatives)
            if done < DISC_STEPS:
                by_disc = np.linalg.solve(np.linalg.inv(covariance)[3:, 3:], fit.score[3:])
                step = np.concatenate([np.zeros(3), by_disc])
            else:
                step = covariance @ fit.score
            by_eye_dpt = np.clip(step[:3], -LARGEST_STEP_DPT, LARGEST_STEP_DPT)
            by_disc_um = step[3:] * min(1.0, LARGEST_STEP_UM / max(float(np.abs(step[3:]).max()), 1e-9))
            eye_dpt, before_um = eye_dpt + by_eye_dpt, pupil.nearest_um
            pupil = pupil.moved(by_disc_um)
            if not pupil.radius_um > MIN_RADIUS_UM:  # also for NaN
                return None
            moved_um = abs(pupil.nearest_um - before_um)
            if done >= DISC_STEPS and moved_um < SETTLED_UM and np.abs(by_eye_dpt).max() < SETTLED_DPT:
                break
        return pupil


class _SpectrumLikelihood:
    """Negative log likelihood of pupils before an eye, for the spectrum of one frame, in nats."""

    def __init__(self, edges: EdgeLikelihood, frame: SampledFrame, eye_dpt: Floats) -> None:
        self._edges, self._frame, self._eye_dpt = edges, frame, eye_dpt
        likelihood = edges.likelihood
        smooth = likelihood.fit_smooth(frame, otf_behind(edges, eye_dpt, None))
        residual = likelihood.residual(frame, smooth, likelihood.stretch(*eye_dpt))
        self._noise_dn2 = noise_power(likelihood.noise(frame, residual), frame)
        self._known: dict[Pupil | None, float] = {}

    def __call__(self, pupil: Pupil | None) -> float:
        """Return the value for a pupil, with a smooth part of its own; None: the whole PSF."""
        if pupil not in self._known:
            self._known[pupil] = self._nats(pupil)
        return self._known[pupil]

    def _nats(self, pupil: Pupil | None) -> float:
        edges, frame, likelihood = self._edges, self._frame, self._edges.likelihood
        grid, fft, band = edges.grid, likelihood.fft, likelihood.bands.whole
        otf = otf_behind(edges, self._eye_dpt, pupil)
        smooth = edges.field.fit(frame.linear, otf, edges.edge)
        likelihood.model.otf = otf
        seen = likelihood.model.blur(smooth.image)[grid.slices] + np.float32(smooth.stray_dn)
        np.multiply(frame.linear.y - seen, frame.known, out=fft.space)
        rest = fft.forward().ravel()[band.where]
        rows, cols = (np.fft.fftfreq(size, 1 / size).astype(int) for size in grid.window)
        fft.space[:] = scipy_fft.irfft2(otf, grid.shape)[np.ix_(rows, cols)]
        return band_likelihood(rest, fft.forward().ravel()[band.where], band, self._noise_dn2).nats


def dark_rim(edges: EdgeLikelihood, eye_dpt: Floats, fit: Fit, psf_radius_px: float) -> float:
    """Return by how many standard deviations the darkest sector of the PSF's rim is too bright for a frame, as a score.

    The derivative of the log likelihood with respect to each sample of the PSF is the correlation of the object with
    the weighted residual; its standard deviation is that beyond the PSF, where no light is.
    """
    grid, likelihood = edges.grid, edges.likelihood
    pitch_um = likelihood.geometry.pitch_um
    right_um, down_um = _places_um(grid, pitch_um, likelihood.stretch(*eye_dpt))
    radius = np.hypot(right_um, down_um) / (psf_radius_px * pitch_um)
    weighted = np.zeros(grid.shape, np.float32)
    weighted[grid.slices] = fit.weighted
    score = scipy_fft.irfft2(scipy_fft.rfft2(weighted) * fit.object.conj(), grid.shape)
    psf: Image = scipy_fft.irfft2(otf_behind(edges, eye_dpt, None), grid.shape)
    rim = (radius > RIM[0]) & (radius < RIM[1])
    sector = np.floor(np.arctan2(down_um, right_um)[rim] * DIRECTIONS / (2 * np.pi) + 0.5).astype(int) % DIRECTIONS
    sums = np.bincount(sector, (score * psf)[rim], DIRECTIONS)
    sds = np.sqrt(np.bincount(sector, psf[rim] ** 2, DIRECTIONS)) * score[radius > OUTSIDE].std()
    return float((-sums / sds).max())
