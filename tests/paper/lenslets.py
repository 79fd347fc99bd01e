"""D: microlenses and aperiodic lenslets instead of the diffuser, at the light of a human eye (the paper's future work).

One head, its own light, several eyes and elements: a seed draws the eye, the diffuser or the lenslets, and the noise.
The pitch was chosen on seed 11, which is none of these (OPTICS.md 2.8).
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from device.config.element import Lenses
from device.sim.plan import decide
from device.values import Image
from tests.lens_packing import lenses_in_iris, random_packing, square_array
from tests.paper.bench import Bench, HeadChanges, SimulatedFrame
from tests.paper.outcome import Claim, Experiment, Figure, Outcome, Table, above
from tests.paper.pictures import plane

SCENE, SEEDS = "human_eye_paper", (21, 22, 23)
KINDS = ("diffuser", "microlenses", "lenslets")
PITCH_UM, IRIS_UM, FOCAL_UM = 400.0, 3200.0, 6000.0
NAMES = {"diffuser": "diffuser", "microlenses": "square array", "lenslets": "aperiodic lenslets"}
BAND_CYCLES_PER_MM = (5.0, 14.5)  # of the sensor: vessels of 90 to 260 um on the retina of a human eye
MYOPIA_DPT = 4.0  # the paper's tolerance
IMPROVED, EVEN = "contrast significantly improved", "caustic better evenly distributed"
FUTURE = "the paper names it and leaves it to future work"
HOW = "ideal lenses in the simulator, whose focal length is the distance to the sensor"


class Passed(NamedTuple):
    """Transfer of detail by one PSF: rms of |H| in the band, and its evenness, geometric mean over rms."""

    rms: float
    evenness: float


class Trial(NamedTuple):
    """One frame behind one element with its picture."""

    take: SimulatedFrame
    picture: Image
    passed: Passed

    @property
    def scores(self) -> tuple[float, float, float]:
        """PCC, PSNR in dB, and vessel contrast."""
        found = self.take.score(self.picture)
        assert found.vessel_contrast is not None
        return found.pcc, found.psnr_db, found.vessel_contrast


def lenses(kind: str, seed: int) -> Lenses:
    """Return the lenses of a square array or of a random packing; `seed` draws the latter."""
    places = square_array(PITCH_UM, IRIS_UM) if kind == "microlenses" else random_packing(PITCH_UM, IRIS_UM, seed)
    return lenses_in_iris(places, FOCAL_UM, IRIS_UM)


def passed_detail(take: SimulatedFrame) -> Passed:
    """Return the transfer of detail from object to frame by the calibrated PSF of a take, of sum 1."""
    assert take.calibration.geometry is not None
    psf = np.asarray(take.calibration.psfs[0].pixels, np.float64)
    pitch_mm = take.calibration.geometry.pitch_um / 1000
    transfer = np.abs(np.fft.rfft2(psf / psf.sum()))
    rows, cols = np.fft.fftfreq(psf.shape[0], pitch_mm), np.fft.rfftfreq(psf.shape[1], pitch_mm)
    frequency = np.hypot(rows[:, None], cols[None, :])
    band = transfer[(frequency >= BAND_CYCLES_PER_MM[0]) & (frequency < BAND_CYCLES_PER_MM[1])]
    rms = float(np.sqrt((band**2).mean()))
    return Passed(rms, float(np.exp(np.log(np.maximum(band, 1e-12)).mean())) / rms)


def trial(bench: Bench, kind: str, seed: int, m_dpt: float = 0.0) -> Trial:
    """Return frame and default picture of the eye `seed`, of `m_dpt`, behind an element, with the PSF of a relaxed eye.

    The frame of an eye with a refractive error is solved by the default schedule, which estimates it.
    """
    bench.progress(f"D: {NAMES[kind]}, eye {seed}" + (f", {m_dpt:+g} dpt" if m_dpt else ""))
    changes: HeadChanges = {"sim.seed": seed, "sim.eye.m_dpt": m_dpt}
    if kind != "diffuser":
        changes = {**changes, "optics.element.kind": "lenslets", "optics.element.lenses": lenses(kind, seed)}
    take = bench.expose(SCENE, changes, partial(decide, without=("lens_curvature",)))
    picture = bench.solve_default(take)[0] if m_dpt else bench.solve(take, "variation")
    return Trial(take, picture, passed_detail(take))


def run_lenslets(bench: Bench) -> Outcome:
    """Solve the same eyes behind the diffuser, a square array and aperiodic lenslets; then one of 4 dioptres."""
    found = {kind: [trial(bench, kind, seed) for seed in SEEDS] for kind in KINDS}
    strained = {kind: trial(bench, kind, SEEDS[0], MYOPIA_DPT) for kind in ("diffuser", "lenslets")}
    passed = {kind: _means([result.passed for result in trials]) for kind, trials in found.items()}
    gains = {kind: _gains(found[kind], found["diffuser"]) for kind in KINDS[1:]}
    kept = strained["lenslets"].scores[0] - strained["diffuser"].scores[0]
    claims = (
        *(_passes(kind, passed) for kind in KINDS[1:]),
        above(
            "evenness of |H|, diffuser over square array",
            passed["diffuser"][1] / passed["microlenses"][1],
            1.0,
            EVEN,
            2,
        )
        .adapted(HOW)
        .limit_from("the paper's ordering"),
        *(
            above(f"PCC, {NAMES[kind]} minus diffuser, least of {len(SEEDS)} eyes", min(gain), 0.0)
            .ours(FUTURE)
            .limit_from("better in every eye")
            for kind, gain in gains.items()
        ),
        above(f"PCC, aperiodic lenslets minus diffuser, an eye of {MYOPIA_DPT:g} dpt", kept, 0.0)
        .ours(f"{FUTURE}; refraction estimated from the frame")
        .limit_from("better"),
    )
    return Outcome(claims, tuple(_shown(found)), (_table(found, passed),), _notes(gains, strained))


def _passes(kind: str, passed: dict[str, list[float]]) -> Claim:
    ratio = passed[kind][0] / passed["diffuser"][0]
    return (
        above(f"rms of |H|, {NAMES[kind]} over diffuser", ratio, 1.0, IMPROVED, 1)
        .ours(FUTURE)
        .limit_from("the paper's ordering")
    )


def _gains(trials: Sequence[Trial], references: Sequence[Trial]) -> list[float]:
    """Return the difference of the PCC of each trial from that of its reference, the same eye."""
    return [result.scores[0] - reference.scores[0] for result, reference in zip(trials, references, strict=True)]


def _means(values: Sequence[tuple[float, ...]]) -> list[float]:
    return [float(mean) for mean in np.mean(values, axis=0)]


def _table(found: dict[str, list[Trial]], passed: dict[str, list[float]]) -> Table:
    rows = []
    for kind, trials in found.items():
        scores = np.array([result.scores for result in trials])
        mean, spread = scores.mean(axis=0), scores.std(axis=0, ddof=1)
        rows.append(
            (
                NAMES[kind],
                *(f"{mean[i]:.{n}f} +- {spread[i]:.{n}f}" for i, n in enumerate((3, 1, 3))),
                f"{passed[kind][0]:.3f}",
                f"{passed[kind][1]:.2f}",
            )
        )
    head = ("element", "PCC, mean +- sd", "PSNR, dB", "vessel contrast", "rms of |H|", "evenness of |H|")
    return Table(head, tuple(rows))


def _shown(found: dict[str, list[Trial]]) -> list[Figure]:
    """Return truth and pictures of the first eye, then the PSFs."""
    first = {kind: trials[0] for kind, trials in found.items()}
    take = first["diffuser"].take
    figures = [replace(plane("truth", take.truth, take.inside), begins=True)]
    for kind, result in first.items():
        pcc, psnr_db, _ = result.scores
        figures.append(plane(f"{NAMES[kind]}: PCC {pcc:.3f}, PSNR {psnr_db:.1f} dB", result.picture, take.inside))
    psfs = [plane(f"PSF, {NAMES[kind]}", np.sqrt(_middle(result.take)), None) for kind, result in first.items()]
    return [*figures, replace(psfs[0], begins=True), *psfs[1:]]


def _middle(take: SimulatedFrame) -> Image:
    """Return the square middle of a take's PSF, as wide as the frame's shorter side."""
    psf = np.maximum(take.calibration.psfs[0].pixels, 0)
    side = min(psf.shape)
    rows, cols = ((size - side) // 2 for size in psf.shape)
    return np.asarray(psf[rows : rows + side, cols : cols + side], np.float32)


def _notes(gains: dict[str, list[float]], strained: dict[str, Trial]) -> tuple[str, ...]:
    better = [NAMES[kind] for kind, gain in gains.items() if min(gain) > 0]
    answer = (
        f"better than the diffuser in every eye: {', '.join(better)}" if better else "none does better in every eye"
    )
    eye = {kind: f"{result.scores[0]:.3f}" for kind, result in strained.items()}
    return (
        f"Does one do better at the light of a real eye? In this simulation: {answer}. A lens of {PITCH_UM:g} um "
        "gathers the light of a point into one spot, so detail keeps about one over the root of their number; the "
        "diffuser spreads it over its whole caustic. The square array has the same spots in a lattice, whose transfer "
        "is uneven as the paper says, and whose copies of the retina the prior must tell apart.",
        f"An eye of {MYOPIA_DPT:g} dpt with the PSF of a relaxed one, the refraction estimated from the frame: "
        f"PCC {eye['diffuser']} behind the diffuser, {eye['lenslets']} behind lenslets.",
        "|H| is the transfer function of the PSF of sum 1, from 5 to 14.5 cycles/mm on the sensor (vessels of 90 to "
        "260 um). Its rms there stands for the paper's \"image contrast\": the share of an object's detail that "
        "reaches the raw frame. Evenness is its geometric mean over its rms: 1 if |H| is the same at all these "
        "frequencies, near 0 if some are missing. The rows on |H| "
        "are ratios of two elements, those on PCC are differences.",
        "Not shown: a real array. The lenses here are ideal, without gaps, aberrations, scatter and wrong thickness; "
        "wider lenses gain more (600 um) until one lens is left, which is a camera that must be focused. A diffuser "
        "is cheap and needs no alignment. Nothing was built or measured.",
    )


EXPERIMENTS = (
    Experiment(
        "D",
        "Lenslets instead of the diffuser",
        "Three eyes in the light of the paper's head, behind a diffuser, a square array of microlenses and aperiodic "
        "lenslets of the same pitch, solved by the default method.",
        '"The image contrast can also be significantly improved by using a properly-designed microlens array or '
        'customized aperiodic microlens array"; the caustic "produces a better evenly distributed transfer '
        'function" than a microlens array.',
        run_lenslets,
    ),
)
