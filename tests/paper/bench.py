"""Shared parts of the paper's experiments: scenes with changes, their frames, reconstructions and scores.

Pictures are compared on samples of about 10 um on the sensor. The spectrum of the caustic (the PSF) ends at 35
cycles/mm (OPTICS.md 2.4), so no detail is lost, and every score of one scene uses the same samples.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from device.clock import SystemClock
from device.config.element import Lenses
from device.config.head_file import InstrumentSpec, load_head
from device.recon.assessment.metrics import PictureScorer, Scores
from device.recon.estimation.defective_pixels import DefectFinder
from device.recon.estimation.refraction.estimator import Refraction, RefractionEstimator
from device.recon.methods import method_named
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.forward_model import periodic_model
from device.recon.model.grid import disc
from device.recon.model.preprocessing import Preprocessor
from device.recon.model.resampling import to_sensor
from device.recon.reconstructor import Reconstructor
from device.recon.solvers.flat_field_correction import flat_field_correct
from device.recon.solvers.wiener import TIKHONOV, ClosedForm
from device.sim.eyes import EffectSelector
from device.sim.plan import decide
from device.sim.scene_files import SimulatedExposure, simulate_exposure
from device.values import Calibration, Image, Mask, Report
from services import resources
from services.research.frontier_oracle import MUS

SCENES = resources.SCENES
SAMPLE_UM = 10.08  # sample pitch of the scores: two of the paper's pixels
RIM_PX = 2.0  # width of the blurred field edge, which is excluded from scores
EVEN_DEG, DETAIL_DEG = 4.0, 2.0

DEFAULT, SCHEDULE = "our default", "the default schedule"  # names of solvers in the report, explained in style.GLOSSARY

ProgressCallback = Callable[[str], None]
HeadChanges: TypeAlias = Mapping[str, bool | int | float | str | tuple[float, float] | Lenses]  # by dotted keys


class Bench:
    """Solvers shared by all experiments; `merged` n combines n x n sensor pixels (1: full resolution)."""

    def __init__(self, merged: int = 1, progress: ProgressCallback = lambda line: None) -> None:
        self.merged, self.progress = merged, progress
        self.planner = Planner(folder=None, effort="FFTW_ESTIMATE")
        self._refractor: tuple[str, RefractionEstimator] | None = None
        self._ladder: tuple[Calibration, Reconstructor] | None = None

    def scene(self, name: str, changes: HeadChanges | None = None) -> InstrumentSpec:
        """Return a shipped scene with merged pixels and changes such as {"sim.eye.m_dpt": 4.0}.

        ValueError for an invalid change.
        """
        return with_merged_pixels(with_changes(load_head(SCENES / f"{name}.toml"), changes or {}), self.merged)

    def expose(
        self, name: str, changes: HeadChanges | None = None, choose: EffectSelector = decide
    ) -> "SimulatedFrame":
        """Return one frame of a scene with changes; `choose` selects its effects."""
        spec = self.scene(name, changes)
        assert spec.sim is not None
        return SimulatedFrame(spec.name, simulate_exposure(spec, choose), spec.sim.object.cut_deg)

    def solve(self, take: "SimulatedFrame", name: str) -> Image:
        """Return the picture by our method `name` with the calibrated PSF, on the samples of the scores."""
        method = method_named(name)
        model = method.model(take.calibration, take.shape, take.samples_px, self.planner, 0)
        solver, out = method.build(model, take.calibration, self.planner), np.zeros(model.grid.shape, np.float32)
        counts = take.staged.counts
        defects = DefectFinder(take.calibration, take.shape)(counts)
        solver.start(Preprocessor(take.calibration, model.grid)(counts, None, defects))
        if method.round_pairs:
            for _ in range(method.rounds):
                solver.step()
        solver.finish(out)
        return take.sampled(to_sensor(out, model.grid))

    def solve_default(self, take: "SimulatedFrame") -> tuple[Image, Report]:
        """Return picture and report of the default schedule, as used by the instrument and by `diffuscope reconstruct`.

        The schedule is: quick look, refraction of the eye, `variation` with the PSF of that eye; no deadline. The
        picture is on the samples of the scores. FrameError for a frame that the instrument refuses.
        """
        if self._ladder is None or self._ladder[0] is not take.calibration:
            self._ladder = take.calibration, Reconstructor(take.calibration, take.shape, self.planner, SystemClock())
        made = self._ladder[1](take.staged.counts, simulated=True)
        return take.sampled(made.picture), made.report

    def refraction(self, take: "SimulatedFrame") -> tuple[float, float, float]:
        """Return M, J0 and J45 estimated from the frame as wavefront in dpt (positive M: myopia); NaN if refused."""
        if self._refractor is None or self._refractor[0] != take.calibration.id:
            found = RefractionEstimator(take.calibration, take.shape, self.planner, 0)
            self._refractor = take.calibration.id, found
        refractor, counts = self._refractor[1], take.staged.counts
        eye = refractor.find(counts, None, refractor.defects(counts))
        if isinstance(eye, Refraction):
            eye = refractor.add_cylinder(eye)
        if not isinstance(eye, Refraction) or eye.cylinder is None:
            return (float("nan"),) * 3
        return eye.m_dpt, eye.cylinder.j0_dpt, eye.cylinder.j45_dpt

    def tikhonov(self, take: "SimulatedFrame", mu: float) -> Image:
        """Return the paper's solution for one weight mu, on the samples of the scores."""
        return next(iter(self.sweep_mu(take, (mu,))))[1]

    def sweep_mu(self, take: "SimulatedFrame", mus: Iterable[float] = MUS) -> Iterable[tuple[float, Image]]:
        """Yield mu and the paper's solution for each weight mu: periodic boundary, no limit of the field of view."""
        calibration = replace(take.staged.calibration, field_deg=None)
        model = periodic_model(calibration, take.shape, take.samples_px, self.planner, 0)
        model.fade = None  # our apodisation for open fields; the paper has none, and its pictures are worse with it
        preparer, out = Preprocessor(calibration, model.grid), np.zeros(model.grid.shape, np.float32)
        for mu in mus:
            solver = ClosedForm(model, TIKHONOV, mu)
            solver.start(preparer(take.staged.counts))
            solver.finish(out)
            yield mu, take.sampled(to_sensor(out, model.grid))

    def best_mu(self, take: "SimulatedFrame") -> tuple[float, Image, Scores]:
        """Return mu, picture and scores of the paper's solution with the highest PCC.

        An oracle replaces the paper's visual choice of mu.
        """
        mu, picture = max(self.sweep_mu(take), key=lambda found: take.pcc(found[1]))
        return mu, picture, take.score(picture)

    def best_detail_mu(self, take: "SimulatedFrame") -> tuple[float, Image]:
        """Return mu and picture of the paper's solution with the highest correlation of the details (high-pass PCC)."""
        return max(self.sweep_mu(take), key=lambda found: take.score(found[1]).highpass_pcc)


@dataclass(frozen=True)
class SimulatedFrame:
    """A simulated frame with its truth, and the samples on which its pictures are scored.

    `cut_deg` (right, down): rectangle to which the object is cut; only what lies inside is scored.
    """

    name: str
    staged: SimulatedExposure
    cut_deg: tuple[float, float] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the sensor."""
        rows, cols = self.staged.counts.shape
        return rows, cols

    @property
    def calibration(self) -> Calibration:
        """Calibration of the simulated head."""
        return self.staged.calibration

    @property
    def px_per_deg(self) -> float:
        """Samples of the scores per degree."""
        assert self.calibration.geometry is not None
        return self.calibration.geometry.px_per_deg / self.samples_px

    @property
    def samples_px(self) -> int:
        """Side in sensor pixels of one sample of the scores."""
        assert self.calibration.geometry is not None
        return max(1, round(SAMPLE_UM / self.calibration.geometry.pitch_um))

    def sampled(self, image: Image) -> Image:
        """Return the means of an image (rows, cols of sensor pixels) over each sample of the scores."""
        n = self.samples_px
        rows, cols = (size // n for size in image.shape)
        first = [(size - count * n) // 2 for size, count in zip(image.shape, (rows, cols), strict=True)]
        cut = image[first[0] : first[0] + rows * n, first[1] : first[1] + cols * n]
        return np.asarray(cut.reshape(rows, n, cols, n).mean(axis=(1, 3)), np.float32)

    @cached_property
    def truth(self) -> Image:
        """True object on the samples of the scores."""
        return self.sampled(self.staged.truth)

    @cached_property
    def raw(self) -> Image:
        """Raw counts minus the black level, on the samples of the scores."""
        return self.sampled(self.staged.counts.astype(np.float32) - np.float32(self.calibration.sensor.black_dn))

    @cached_property
    def inside(self) -> Mask:
        """Mask of the field, or of the object cut out of it, without its edge, on the samples of the scores."""
        field = self._disc(field_radius_px(self.calibration) / self.samples_px - RIM_PX) > 0.5
        return np.asarray(field & rectangle(field.shape, self.cut_deg, self.px_per_deg, RIM_PX))

    def _disc(self, radius_px: float) -> Image:
        rows, cols = self.truth.shape
        return disc((rows, cols), ((rows - 1) / 2, (cols - 1) / 2), radius_px)

    @cached_property
    def judge(self) -> PictureScorer:
        """Scorer of pictures on the samples against the truth inside the field."""
        vessels = self.staged.vessels
        known = None if vessels is None else self.sampled(vessels.astype(np.float32)) > 0.5
        return PictureScorer(self.truth, self.inside, DETAIL_DEG * self.px_per_deg, known)

    def score(self, picture: Image) -> Scores:
        """Return the scores of a picture on the samples."""
        return self.judge(picture)

    def pcc(self, picture: Image) -> float:
        """Return Pearson's correlation of a picture with the truth inside the field."""
        return float(np.corrcoef(picture[self.inside], self.truth[self.inside])[0, 1])

    def flat_field_corrected(self, picture: Image) -> Image:
        """Return a picture divided by its own Gaussian blur (sigma EVEN_DEG), times its mean; zero outside the outline.

        The outline is that of the field, or of the object cut out of it. For continuous pictures;
        `screen.flat_field_corrected` differs: it fits the peaks of dots.
        """
        disc_of_field = self._disc(field_radius_px(self.calibration) / self.samples_px)
        outline = disc_of_field * rectangle(picture.shape, self.cut_deg, self.px_per_deg)
        return flat_field_correct(picture, np.asarray(outline, np.float32), EVEN_DEG * self.px_per_deg)

    def column(self, right_deg: float) -> int:
        """Return the index of the sample column `right_deg` to the right of the axis."""
        return round(float((self.truth.shape[1] - 1) / 2 + right_deg * self.px_per_deg))

    def row(self, down_deg: float) -> int:
        """Return the index of the sample row `down_deg` below the axis."""
        return round(float((self.truth.shape[0] - 1) / 2 + down_deg * self.px_per_deg))


def rectangle(
    shape: tuple[int, ...], sides_deg: tuple[float, float] | None, px_per_deg: float, rim_px: float = 0.0
) -> Mask:
    """Return the mask (rows, cols) of a centred rectangle less a rim; sides (right, down). True everywhere for None."""
    if sides_deg is None:
        return np.ones(shape, np.bool_)
    rows, cols = (np.abs(np.arange(n) - (n - 1) / 2) for n in shape)
    across, down = (side * px_per_deg / 2 - rim_px for side in sides_deg)
    return np.asarray((rows[:, None] < down) & (cols[None, :] < across))


def with_changes(spec: InstrumentSpec, changes: HeadChanges) -> InstrumentSpec:
    """Return a head with some keys changed (dotted names), validated like a head file; ValueError if invalid."""
    tree = spec.model_dump()
    for dotted, value in changes.items():
        *tables, key = dotted.split(".")
        table = tree
        for name in tables:
            table = table[name]
        table[key] = value
    return InstrumentSpec.model_validate(tree)


def with_merged_pixels(spec: InstrumentSpec, n: int) -> InstrumentSpec:
    """Return the head with n x n pixels combined: light and full well times n^2, read noise times n.

    The light of a budget follows the pixels by itself.
    """
    camera = spec.camera
    assert spec.sim is not None
    merged: HeadChanges = {
        "camera.rows": camera.rows // n,
        "camera.cols": camera.cols // n,
        "camera.pitch_um": camera.pitch_um * n,
        "camera.full_well_e": camera.full_well_e * n**2,
        "camera.read_noise_e": camera.read_noise_e * n,
        "sim.peak_e": spec.sim.peak_e if spec.sim.peak_e == "budget" else spec.sim.peak_e * n**2,
    }
    return with_changes(spec, merged)
