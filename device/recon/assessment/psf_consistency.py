"""PSF consistency check: does a frame come through the given PSF, and in the given orientation.

Two independent tests on tapered spectra Y of the frame; the amplitude test uses one taper, the phase test two:

* amplitude: in narrow rings of frequencies |Y|^2 rises with |H|^2. `score` is the slope, 1 for an exact PSF without
  noise, 0 for another diffuser's; light outside the sensor's edge and an inaccurate PSF lower it to 0.2. It does not
  change under a rotation by 180 degrees, because |H| does not.
* phase: the frame is deconvolved with conj(H) and with H, the PSF rotated by 180 degrees. Both pictures have the same
  power spectrum, so only their phases differ: the right one has sparse gradients (edges on smooth ground), the wrong
  one is noise-like. `orientation` is the difference of their sparsity,

      S(x) = mean log(1 + |D x|^2 / mean |D x|^2),    (S(rotated) - S(given)) / sd

  where sd is the rms of the same difference over null PSFs: the given PSF and its mirror image, rotated by ANGLES_DEG.
  The two tapers are averaged, and the mean is scaled by its own rms over the null PSFs. The narrow taper keeps more
  light; the wide one hides the false edge of a field that extends past the sensor. Large positive values prove the
  given PSF, large negative ones the rotated PSF; values near 0 prove nothing. `mirrored` is the same figure for the PSF
  mirrored left to right: positive for that PSF, negative for the PSF mirrored top to bottom.

Figures on recordings and simulated frames, and the choice of the limits:
device/recon/decisions/0007-psf-consistency.md.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft
from scipy import ndimage

from device.recon.estimation.power_law_prior import band
from device.recon.model.forward_model import taper
from device.recon.model.grid import Grid, Pair
from device.recon.model.kernels import Pixels, Places
from device.recon.model.preprocessing import Linear, Preprocessor
from device.recon.model.resolution import STOPBAND_SHARE_OPEN, working_bin
from device.values import Calibration, Image, Psf

ANGLES_DEG = np.linspace(30, 150, 8)  # of the null PSFs; the other half circle gives the same values with opposite sign
PROVEN = 5.0  # sd of `orientation` and `mirrored`
MATCHES, PER_SD = 0.5, 0.035  # least score of a right PSF, and its decrease per sd of `orientation`
MAX_SD = 0.1  # of a score that proves a mismatch: 0.07 at 144 electrons, 0.25 for noise alone
TAPER_SHARES = (0.25, 0.45)  # of the short side; `score` uses the first
MAX_BIN = 4
MIN_SAMPLES = 64  # of the short side
MAX_SAMPLES = 400_000
RING = 250  # frequencies, as in `psf_match_any_refraction`
MAX_MISSING = 0.04  # share of the pixels: with reflexes and 6 to 7 % missing, two frames of 48 scored as foreign
MIN_SIGNAL = 1.3  # over the noise; below, right PSFs score as low as foreign ones (500 electrons at the peak: 1.2)
AXIS = 3  # cycles across the frame: bad columns, bad rows and the false edge of a cut-off field are below
PSF_ERROR = 0.02  # of the mean |H|^2: limits the gain at frequencies that the PSF does not pass
SCALES = np.arange(-12, 13) * 0.0025 + 1  # of the PSF: eyes of +-8 dpt, or another depth
MIN_SPREAD = 1e-7  # below, the PSF equals its own rotation and has no orientation

Floats = NDArray[np.float64]
Spectrum = NDArray[np.complex64]


class Match(Enum):
    """Result of the PSF test; UNKNOWN if the data are insufficient for a decision."""

    CONSISTENT = "consistent"
    UNKNOWN = "unknown"
    ROTATED = "rotated by 180 degrees"
    MIRRORED_LEFT_RIGHT = "mirrored left to right"
    MIRRORED_UP_DOWN = "mirrored up to down"
    FOREIGN = "does not match"
    FOREIGN_OR_FAR = "does not match, or not with the refraction of an eye within 10 dpt"


@dataclass(frozen=True)
class Consistency:
    """Figures of one frame: `score` with its standard deviation, `orientation` and `mirrored` in null-PSF sd."""

    score: float
    score_sd: float
    orientation: float
    mirrored: float

    @property
    def report_figures(self) -> dict[str, float | None]:
        """The figures by their names in a report."""
        return {
            "psf_score": self.score,
            "psf_score_sd": self.score_sd,
            "psf_orientation": self.orientation,
            "psf_mirrored": self.mirrored,
        }

    @property
    def match(self) -> Match:
        """Result of the test from score, sd, `orientation` and `mirrored`, with the limit L of the score.

        L = MATCHES - PER_SD |orientation|. If score + 2 sd < L: UNKNOWN for sd > MAX_SD, MIRRORED for |mirrored| >
        PROVEN, else FOREIGN. Otherwise: ROTATED for orientation < -PROVEN, CONSISTENT for score - 2 sd > L, else
        UNKNOWN.
        """
        least = MATCHES - PER_SD * abs(self.orientation)
        if self.score + 2 * self.score_sd >= least:
            if self.orientation < -PROVEN:
                return Match.ROTATED
            return Match.CONSISTENT if self.score - 2 * self.score_sd > least else Match.UNKNOWN
        if self.score_sd > MAX_SD:
            return Match.UNKNOWN
        if abs(self.mirrored) > PROVEN:
            return Match.MIRRORED_LEFT_RIGHT if self.mirrored > 0 else Match.MIRRORED_UP_DOWN
        return Match.FOREIGN


class PsfConsistency:
    """PSF consistency check of frames of one sensor shape, for one PSF of a calibration.

    Run time: 0.4 s for 1080 x 1920, three times that if the first result is FOREIGN.

    Parameters
    ----------
    calibration
        Calibration of the head.
    shape
        (rows, cols) of the sensor in pixels.
    index
        Index of the PSF in the calibration.
    """

    def __init__(self, calibration: Calibration, shape: Pair, index: int = 0) -> None:
        psf = calibration.psfs[index]
        n = min(working_bin(psf, STOPBAND_SHARE_OPEN), MAX_BIN)
        while shape[0] // n * (shape[1] // n) > MAX_SAMPLES:
            n += 1
        while n > 1 and min(shape) // n < MIN_SAMPLES:
            n -= 1
        self._grid = Grid.periodic(shape, n, float("inf"))
        self._preparer = Preprocessor(calibration, self._grid)
        self._psf = binned(psf, n)
        rows, cols = self._grid.shape
        row_cycles = np.abs(np.fft.fftfreq(rows, 1 / rows))
        col_cycles = np.fft.rfftfreq(cols, 1 / cols)
        self._frequency = np.hypot(row_cycles[:, None] / rows, col_cycles[None] / cols)
        self._off_axes = (row_cycles > AXIS)[:, None] & (col_cycles > AXIS)[None]
        self._tapers = [taper(self._grid.window, share) for share in TAPER_SHARES]

    def __call__(self, counts: Pixels, scale: float = 1.0, defects: Places | None = None) -> Consistency | None:
        """Return score, orientation and mirror test of a frame.

        A FOREIGN result is tested again at the best of SCALES; ROTATED, or CONSISTENT with orientation >
        PROVEN, then replaces it.

        Parameters
        ----------
        counts
            Counts, (rows, cols) or (rows, cols, 3).
        scale
            Scale of the PSF; 1: as stored.
        defects
            Flat indices of defective pixels, which are filled from their surroundings, see `DefectFinder`.

        Returns
        -------
        Consistency or None
            None if a side of the grid has fewer than MIN_SAMPLES / 2 samples, if the PSF passes too few usable
            frequencies, or if the result is FOREIGN and either the share of missing pixels is above MAX_MISSING
            or the mean |Y|^2 is below MIN_SIGNAL times the noise.
        """
        if min(self._grid.shape) < MIN_SAMPLES // 2:
            return None
        plane = counts if counts.ndim == 2 else counts.mean(axis=2).astype(np.float32)
        frame = self._preparer(plane, None, defects)
        spectra = self._tapered_spectra(frame)
        found = self._evaluate(spectra, stretched(self._psf, scale))
        if found is None or found.match is not Match.FOREIGN:
            return found
        best = max(SCALES, key=lambda s: self._score(spectra[0], self._otf(stretched(self._psf, s)))[0])
        again = self._evaluate(spectra, stretched(self._psf, float(best)))
        proven = again is not None and again.match is Match.CONSISTENT and again.orientation > PROVEN
        rotated = again is not None and again.match is Match.ROTATED
        if proven or rotated:
            return again
        return found if frame.missing <= MAX_MISSING and self._signal(spectra[0]) >= MIN_SIGNAL else None

    def _signal(self, spectrum: Spectrum) -> float:
        """Return the mean |Y|^2 in the band over the noise per frequency: 1 for noise only."""
        power = _power(self._otf(self._psf))
        seen = _power(spectrum)
        low, high = band(self._frequency, power, max(self._grid.window))
        inside = (self._frequency > low) & (self._frequency < high) & self._off_axes
        return float(seen[inside].mean()) / max(self._noise(seen, power), 1e-30)

    def _tapered_spectra(self, frame: Linear) -> list[Spectrum]:
        """Return the spectrum of the tapered frame minus its mean, for each taper; 0 near the frequency axes."""
        y = filled(frame.y, frame.good)
        spectra = []
        for window in self._tapers:
            mean = float((y * window).sum() / window.sum())
            spectrum = scipy_fft.rfft2((y - np.float32(mean)) * window)
            spectra.append(np.asarray(spectrum * self._off_axes, np.complex64))
        return spectra

    def _otf(self, psf: Image) -> Spectrum:
        spectrum = scipy_fft.rfft2(np.fft.ifftshift(psf))
        return np.asarray(spectrum / max(float(spectrum[0, 0].real), 1e-12), np.complex64)

    def _evaluate(self, spectra: list[Spectrum], psf: Image) -> Consistency | None:
        otf = self._otf(psf)
        score, sd = self._score(spectra[0], otf)
        if not np.isfinite(sd):
            return None
        rotated = (ndimage.rotate(psf, angle, reshape=False, order=1) for angle in ANGLES_DEG)
        images = [view for image in (psf, *rotated) for view in (image, image[:, ::-1])]
        amplitudes = [self._deconvolved_amplitude(spectrum, otf) for spectrum in spectra]
        differences = np.array([self._sparsity_differences(amplitudes, self._otf(image)) for image in images])
        spread = np.sqrt((differences[2:] ** 2).mean(axis=0))
        if spread.min() < MIN_SPREAD:
            return Consistency(score, sd, 0.0, 0.0)
        total = (differences / spread).sum(axis=1)
        total /= np.sqrt((total[2:] ** 2).mean())
        return Consistency(score, sd, float(total[0]), float(total[1]))

    def _score(self, spectrum: Spectrum, otf: Spectrum) -> tuple[float, float]:
        """Return the slope of |Y|^2 against |H|^2 in narrow rings, and its standard deviation.

        The estimator of `psf_match_any_refraction`, with the rings summed at once for the search over SCALES: another
        order of the sums, so the last bits differ. (0, inf) without usable frequencies.
        """
        power = _power(otf)
        seen = _power(spectrum)
        low, high = band(self._frequency, power, max(self._grid.window))
        noise = self._noise(seen, power)
        inside = np.flatnonzero((self._frequency > low) & (self._frequency < high) & self._off_axes)
        order = inside[np.argsort(self._frequency.ravel()[inside], kind="stable")]
        starts = np.arange(0, max(order.size - RING // 2, 1), RING)
        if order.size < RING or not noise > 0:
            return 0.0, float("inf")
        counts = np.diff(np.append(starts, order.size))
        energy = seen.ravel()[order]
        power = power.ravel()[order]
        mean_power = np.add.reduceat(power, starts) / counts
        mean = np.add.reduceat(energy, starts) / counts
        speckle = power - np.repeat(mean_power, counts)
        spread = np.add.reduceat(speckle**2, starts) / mean**2
        found = float((np.add.reduceat(speckle * energy, starts) / mean**2).sum())
        expected = float((np.maximum(mean - noise, 0) / mean_power * spread).sum())
        if expected <= 0:
            return 0.0, float("inf")
        return found / expected, float(spread.sum()) ** 0.5 / expected

    def _deconvolved_amplitude(self, spectrum: Spectrum, otf: Spectrum) -> Spectrum:
        """Return Y |H| / (|H|^2 + regularisation), a Wiener solution without the phase of H; prior power ~ 1/f."""
        power = _power(otf)
        seen = _power(spectrum)
        low, high = band(self._frequency, power, max(self._grid.window))
        part = (self._frequency > low) & (self._frequency < high)
        noise = self._noise(seen, power)
        frequency = np.maximum(self._frequency, low / 5)
        mean_power = float(power[part].mean())
        level = max(float(seen[part].mean()) - noise, 1e-12 * noise) / float((power[part] / frequency[part]).mean())
        kept = spectrum * (np.sqrt(power) / (power + noise / level * frequency + PSF_ERROR * mean_power))
        kept[0, 0] = 0
        return np.asarray(kept, np.complex64)

    def _noise(self, seen: Floats, power: Floats) -> float:
        """Return the noise per frequency: the median over the quarter with the lowest |H|^2, divided by ln 2."""
        stopband = self._off_axes & (power <= np.quantile(power, 0.25))
        return float(np.median(seen[stopband])) / float(np.log(2))

    def _sparsity_differences(self, amplitudes: list[Spectrum], otf: Spectrum) -> list[float]:
        """Return, for each amplitude, S with the phase of the rotated PSF minus S with the phase of the PSF."""
        phase = np.conj(otf) / np.maximum(np.abs(otf), np.float32(1e-20))
        found = []
        for amplitude in amplitudes:
            given, rotated = (scipy_fft.irfft2(amplitude * p, self._grid.shape) for p in (phase, np.conj(phase)))
            found.append(sparsity(rotated) - sparsity(given))
        return found


def sparsity(image: Image) -> float:
    """Return mean log(1 + |D x|^2 / mean |D x|^2): small if few samples hold most of the gradient; 0 if constant."""
    squared = np.diff(image, axis=0)[:, :-1] ** 2 + np.diff(image, axis=1)[:-1] ** 2
    mean = float(squared.mean())
    return float(np.log1p(squared / np.float32(mean)).mean()) if mean > 0 else 0.0


def binned(psf: Psf, n: int) -> Image:
    """Return the PSF as sums of n x n pixels, (rows // n, cols // n), with its orientation; its position may shift."""
    rows, cols = (size // n for size in psf.shape)
    top, left = ((size - count * n) // 2 for size, count in zip(psf.shape, (rows, cols), strict=True))
    part = psf.pixels[top : top + rows * n, left : left + cols * n]
    sums: Image = part.reshape(rows, n, cols, n).sum(axis=(1, 3))
    return sums


def stretched(psf: Image, scale: float) -> Image:
    """Return the PSF scaled about its centre by linear interpolation, with the same shape."""
    if scale == 1:
        return psf
    middle = (np.array(psf.shape) - 1) / 2
    image: Image = ndimage.affine_transform(psf, np.full(2, 1 / scale), middle * (1 - 1 / scale), order=1)
    return image


def filled(y: Image, good: Image) -> Image:
    """Return the frame with its gaps filled by normalised Gaussian interpolation of the good samples.

    An unfilled gap would add its own spectrum. `y` and `good` are (rows, cols); `good` is 0 to 1, a gap has at most
    0.5. Without gaps, or without a good sample, `y` itself is returned.
    """
    there = (good > 0.5).astype(np.float32)
    if there.all() or not there.any():
        return y
    image = np.where(there > 0, y, np.float32(0))
    known = there
    width = 2.0
    while not known.all():
        weight = ndimage.gaussian_filter(known, width)
        near = ndimage.gaussian_filter(image * known, width) / np.maximum(weight, 1e-6)
        found = (known == 0) & (weight > 0.05)
        image = np.where(found, near, image)
        known = np.where(found, np.float32(1), known)
        width *= 2
    return np.asarray(image, np.float32)


def _power(spectrum: Spectrum) -> Floats:
    return np.asarray(np.abs(spectrum).astype(np.float64) ** 2)
