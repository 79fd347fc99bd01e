"""Quality figures of a picture without a reference image, and the messages that follow from them (NUMERICS.md 8.1)."""

from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum
from math import prod

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.recon.assessment.psf_consistency import MAX_MISSING, Match
from device.recon.estimation.power_law_prior import BINS, PowerLaw, PowerLawPrior
from device.values import Geometry, Image, Mask

RETINA_UM_PER_DEG = 296.7  # human eye, 17 mm; OPTICS.md 1.1
MIN_THROUGH = 0.5  # eyes have 0.9 and more, an even screen 0.03
MISMATCH_SD = 3.0  # standard errors
MIN_LIT = 0.75  # share of the field
MIN_EXPLAINED_LIT = 0.95  # below, the field may be smaller than it was given: discs of 0.97 of it have 0.94
SQUARES = 64  # across the field, each of which is lit or dark
NEAR_SQUARES = 5  # side of the surroundings of one: in little light a single square is noise
MAX_MISFIT = 5.2  # rms over noise: 1 in good frames, 4 to 4.9 behind a lid or in stray light, 5.6 to 23 in flicker
MAX_BANDING = 0.0013  # clean frames 0.0003, half a lid 0.0008, flicker of 1 % 0.0015 to 0.006, of 10 % 0.02 to 0.07
NOISE_PARTS = 5  # frames without flicker have up to 3.6, at 250 electrons; 2 % of flicker there 17
# Light of a whole frame over its noise. Drawn eyes on two sensors: 4100 to 5000 at 50 electrons at the peak (detail
# correlates by 0.07 to 0.38 with the truth), 6300 and more at 100, 7700 and more at 144 (tests/hard/test_quality.py).
MIN_LIGHT_SNR = 5500.0
MAX_UNSEEN = 0.1  # share of the pixels: where more is missing, figures of the spectrum rise as the picture gets worse
MAX_SATURATED = 0.001  # share of the pixels
# Figures that use the PSF: set to None if the model does not explain the frame.
STRUCTURE = ("structure_nats", "structure_sure")
PSF_FIGURES = (*STRUCTURE, "cutoff_per_px", "resolution_um", "coverage")
SPECTRUM_FIGURES = ("cutoff_per_px", "resolution_um")
FAINT_DN = 1e-9
NO_SIGNAL = "There is no signal in this frame."
PARTLY_LIT = "of the field is lit"
LITTLE_LIGHT = "too little light"
UNEXPLAINED = "The picture does not explain this frame: parts of it may be false."
# The words of these messages and of `quality_warnings` are sorted by KINDS in tests/hard/judgement.py.
MISMATCHES = {
    Match.FOREIGN: "The PSF does not match this frame. Give the PSF of this optic and camera, or measure it again.",
    Match.FOREIGN_OR_FAR: "The refraction of this eye is beyond 10 dpt, which this head does not correct, or the PSF "
    "is not that of this head.",
    Match.ROTATED: "The PSF is rotated by 180 degrees against this frame. Rotate the PSF by 180 degrees; run it again.",
    Match.MIRRORED_LEFT_RIGHT: "The PSF is mirrored left to right against this frame. Mirror the PSF; run it again.",
    Match.MIRRORED_UP_DOWN: "The PSF is mirrored top to bottom against this frame. Mirror the PSF; run it again.",
}
Series = NDArray[np.float64]


class Audience(Enum):
    """Reader of the warnings: the operator of the instrument, or the reader of a reconstructed file."""

    OPERATOR = "operator"
    FILES = "files"


@dataclass(frozen=True)
class Limit:
    """Frequency where signal and noise are equal, in cycles per sensor pixel, and its half period on the retina in um;
    the latter is None if the geometry is unknown or the frequency is 0.
    """

    cycles_per_px: float
    half_period_um: float | None


def cutoff(evidence: PowerLawPrior, law: PowerLaw, noise_dn2: float, n: int, geometry: Geometry | None) -> Limit:
    """Return the lowest frequency at which the ring mean of |H|^2 g / s2 is below 1 (NUMERICS.md 8.1, cutoff).

    The rings are tested from low to high frequency, so an isolated frequency of high SNR beyond is ignored. The result
    is 0 if the first ring fails, the end of the band if none does. `noise_dn2` (s2) is the noise power per frequency of
    the unnormalised DFT, not the variance of a pixel; `n` is the bin in pixels.
    """
    snr = evidence.power * np.exp(law.log_power - law.slope * evidence.logs) / noise_dn2
    sums = np.bincount(evidence.bins, snr, BINS)
    means = sums / np.maximum(np.bincount(evidence.bins, minlength=BINS), 1)
    below = np.flatnonzero(means < 1)
    last = int(below[0]) if below.size else BINS
    edges = np.geomspace(evidence.low, evidence.high, BINS + 1)
    per_px = float(edges[last]) / n if last > 0 else 0.0
    if geometry is None or per_px == 0:
        return Limit(per_px, None)
    per_deg = per_px * geometry.px_per_deg
    return Limit(per_px, 0.5 / per_deg * RETINA_UM_PER_DEG)


def structure(evidence: PowerLawPrior, seen: Series, levels: Series, noise_dn2: float) -> tuple[float, float]:
    """Return the mean log-likelihood gain of the PSF's |H|^2 over a smooth spectrum, in nats and in standard errors.

    NUMERICS.md 8.1, structure. The smooth spectrum is the ring mean of `seen`. A second value below -MISMATCH_SD
    indicates the PSF of another head; a value near 0 is inconclusive: at low light only the lowest frequencies, a small
    part of the band, have an SNR above 1, so the mean is near 0 also for a correct PSF. `seen` is |spectrum|^2,
    (frequencies,); `levels` is (BINS,).
    """
    rings = np.bincount(evidence.bins, minlength=BINS)
    smooth = (np.bincount(evidence.bins, seen, BINS) / np.maximum(rings, 1))[evidence.bins]
    smooth = np.maximum(smooth, FAINT_DN)
    model = evidence.power * levels[evidence.bins] + noise_dn2
    better = (np.log(smooth) + seen / smooth) - (np.log(model) + seen / model)
    mean = float(better.mean())
    return mean, mean * float(better.size) ** 0.5 / max(float(better.std()), FAINT_DN)


def coverage(picture: Image, mask: Image, noise_dn: float) -> float:
    """Return the share of the field whose surroundings are brighter than a third of their median and 3 x the noise.

    The surroundings of each of SQUARES squares across the field are NEAR_SQUARES wide; the median is that of their
    means. NUMERICS.md 8.1, coverage.
    """
    inside = mask > 0.5
    size = np.count_nonzero(inside)
    if not size:
        return 0.0
    side = max(1, round(2 * (size / np.pi) ** 0.5 / SQUARES))
    light, area = (_square_sums(image, side) for image in (np.where(inside, picture, 0), inside))
    near = ndimage.uniform_filter(light, NEAR_SQUARES, mode="constant")
    near /= np.maximum(ndimage.uniform_filter(area, NEAR_SQUARES, mode="constant"), 1 / NEAR_SQUARES**2)
    bright = max(float(np.median(near[area >= area.max() / 2])) / 3, 3 * noise_dn)
    return float(area[near > bright].sum() / size)


def _square_sums(image: Image | Mask, side: int) -> Series:
    """Return the sums over squares of `side` samples; those at the far edges may be cut off."""
    rows = np.add.reduceat(image, np.arange(0, image.shape[0], side), axis=0, dtype=np.float64)
    return np.asarray(np.add.reduceat(rows, np.arange(0, image.shape[1], side), axis=1))


def banding(left: Image, noise_dn2: float, light_dn: float) -> float:
    """Return the flicker figure: the rms of the row means of the residual, as a share of the mean light.

    Rows are read one after the other, so a flickering lamp causes horizontal bands that the forward model cannot
    explain. `left` (rows, cols) in DN is the residual, 0 for missing samples. NOISE_PARTS times the variance of the row
    means of noise with `noise_dn2` is subtracted, so that noise alone gives 0.
    """
    if not light_dn > 0:
        return 0.0
    seen_dn2 = float(left.mean(axis=1, dtype=np.float64).var())
    return float(max(seen_dn2 - NOISE_PARTS * noise_dn2 / left.shape[1], 0.0) ** 0.5 / light_dn)


def is_banded(quality: dict[str, float | None]) -> bool:
    """Return True if `banding` exceeds MAX_BANDING; False if it is unknown."""
    share = quality.get("banding")
    return share is not None and share > MAX_BANDING


def is_explained(quality: dict[str, float | None], match: Match | None, misfit: float | None) -> bool:
    """Return True if the forward model fits the frame; figures that use the PSF are valid only then.

    False if the PSF does not match, the light did not come through the eye, `misfit` (rms residual in units of the
    noise) is above MAX_MISFIT, or the light flickered.
    """
    through = quality.get("through")
    seen = through is None or through >= MIN_THROUGH
    fits = (misfit is None or misfit <= MAX_MISFIT) and not is_banded(quality)
    return seen and match not in MISMATCHES and fits


def is_lit(quality: dict[str, float | None]) -> bool:
    """Return True if the lit share of the field is sufficient for estimates that use its edge, or unknown."""
    share = quality.get("coverage")
    return share is None or share >= MIN_LIT


def is_measured(name: str, quality: dict[str, float | None]) -> bool:
    """Return True if the figure `name`, one of PSF_FIGURES, is valid for a frame that the model explains.

    `coverage` always is. The others are valid if the field is lit and at most MAX_UNSEEN of the frame is missing, the
    resolution also only if the frame has the PSF's structure: the power of a glare's halo would count as detail.
    """
    if name == "coverage":
        return True
    is_foreign = name in SPECTRUM_FIGURES and (quality.get("structure_sure") or 0.0) < -MISMATCH_SD
    return is_lit(quality) and (quality.get("missing") or 0.0) <= MAX_UNSEEN and not is_foreign


def psf_match(quality: dict[str, float | None]) -> Match:
    """Return FOREIGN if `structure_sure` is below -MISMATCH_SD, else UNKNOWN; for frames without a consistency check.

    UNKNOWN also if more than MAX_MISSING of the frame is missing, because gaps have a spectrum of their own, and if no
    ring of frequencies is above the noise: below 250 electrons at the peak the right PSF has -5 to 1.
    """
    sure = quality.get("structure_sure")
    missing = quality.get("missing") or 0.0
    is_seen = (quality.get("cutoff_per_px") or 0.0) > 0
    surely_foreign = sure is not None and sure < -MISMATCH_SD and is_seen and missing <= MAX_MISSING
    return Match.FOREIGN if surely_foreign else Match.UNKNOWN


def light_over_noise(mean_dn: float, noise_dn: float | None, shape: tuple[int, int]) -> float | None:
    """Return the light of a whole frame of `shape` pixels over its noise; None if the noise of a pixel is unknown."""
    return float(mean_dn / noise_dn * prod(shape) ** 0.5) if noise_dn else None


def states_misfit(warnings: Collection[str]) -> bool:
    """Return whether the warnings of a report state that frame and PSF, or frame and picture, do not fit."""
    return any(words in MISMATCHES.values() or words.startswith(UNEXPLAINED) for words in warnings)


def quality_warnings(
    quality: dict[str, float | None],
    match: Match,
    misfit: float | None,
    audience: Audience = Audience.OPERATOR,
    light_snr: float | None = None,
) -> tuple[str, ...]:
    """Return the warnings about a picture in plain words, the most useful first; empty if there are none.

    `misfit` is the rms residual in units of the noise; None if the field is unknown. `light_snr` is the light of the
    whole frame, over which each point of the retina spreads, over its noise; None if the head is unknown. The rules are
    the same for every audience; the operator of the instrument reads what to do at the eye, the reader of a file what
    the frame shows.
    """
    found = []
    explained = is_explained(quality, match, misfit)
    if (quality["saturated"] or 0) > MAX_SATURATED:
        found.append("saturated")
    through = quality.get("through")
    if through is not None and through < MIN_THROUGH:
        found.append("diffuse")
    elif match in MISMATCHES:
        found.append("mismatch")
    elif not explained:
        found.append("unexplained")
    if explained and not is_lit(quality):
        found.append("partly lit")
    if explained and light_snr is not None and light_snr < MIN_LIGHT_SNR:
        found.append("too dark")
    words = _words_for_files(quality) if audience is Audience.FILES else _words_for_operators(quality)
    return tuple(MISMATCHES[match] if cause == "mismatch" else words[cause] for cause in found)


def _words_for_operators(quality: dict[str, float | None]) -> dict[str, str]:
    return {
        "saturated": f"{quality['saturated']:.1%} of the pixels are too bright. Move back a little; take it again.",
        "diffuse": "No eye found: the light came from everywhere. Point the camera at the pupil.",
        "unexplained": f"{UNEXPLAINED} Take it again in steady light.",
        "partly lit": (
            f"Only {quality.get('coverage') or 0:.0%} {PARTLY_LIT}. Ask to look at the green light; take it again."
        ),
        "too dark": "Too little light came back for vessels. Point the camera at the pupil; take it again.",
    }


def _words_for_files(quality: dict[str, float | None]) -> dict[str, str]:
    return {
        "saturated": f"{quality['saturated']:.1%} of the pixels are too bright: they are saturated and were left out.",
        "diffuse": "The light of this frame came from everywhere: most of it did not pass the diffuser as in the PSF.",
        "unexplained": f"{UNEXPLAINED} Flicker and stray light are possible causes.",
        "partly lit": f"Only {quality.get('coverage') or 0:.0%} {PARTLY_LIT}: the rest of the picture is dark.",
        "too dark": f"This frame holds {LITTLE_LIGHT} for vessels: what looks like one may be noise.",
    }
