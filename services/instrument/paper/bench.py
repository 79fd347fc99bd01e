"""The optical bench of the rerun: scenes with a change or two, frames of them, pictures from the frames, scores.

Pictures are compared on samples of about 10 um on the sensor: the caustic's spectrum ends at 35 cycles/mm (optics.md
2.1), so that nothing is lost, and every score of one scene is on the same samples.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from device import sim
from device.clock import SystemClock
from device.recon.closed import TIKHONOV, ClosedForm
from device.recon.defects import DefectFinder
from device.recon.evenness import even_out
from device.recon.geometry import disc
from device.recon.methods import method_named
from device.recon.metrics import Judge, Scores
from device.recon.model import field_radius_px, periodic_model
from device.recon.plan import Planner
from device.recon.prepare import Preparer
from device.recon.reconstructor import Reconstructor
from device.recon.refraction import Refractor
from device.recon.upsample import to_sensor
from device.sim.staged import Staged, staged
from device.spec import InstrumentSpec, load_head
from device.values import Calibration, Image, Mask, Report
from services.instrument.frontier_oracle import MUS

SCENES = Path(sim.__file__).parent / "scenes"
SAMPLE_UM = 10.08  # of the scores: two of the paper's pixels
RIM_PX = 2.0  # the field's soft rim belongs to neither side
EVEN_DEG, DETAIL_DEG = 4.0, 2.0

Say = Callable[[str], None]


class Bench:
    """What all experiments share: how many sensor pixels are merged before anything else (1: the whole sensor)."""

    def __init__(self, merged: int = 1, say: Say = lambda line: None) -> None:
        self.merged, self.say = merged, say
        self.planner = Planner(folder=None, effort="FFTW_ESTIMATE")
        self._refractor: tuple[str, Refractor] | None = None
        self._ladder: tuple[Calibration, Reconstructor] | None = None

    def scene(self, name: str, changes: Mapping[str, Any] | None = None) -> InstrumentSpec:
        """A shipped scene with changes like {"sim.eye.m_dpt": 4.0}, its pixels merged; ValueError if one is wrong."""
        return merged(changed(load_head(SCENES / f"{name}.toml"), changes or {}), self.merged)

    def take(self, name: str, changes: Mapping[str, Any] | None = None) -> "Take":
        """One frame of a scene."""
        spec = self.scene(name, changes)
        return Take(spec.name, staged(spec))

    def solve(self, take: "Take", name: str) -> Image:
        """The picture by one of our methods, with the PSF as calibrated, on the samples of the scores."""
        method = method_named(name)
        model = method.model(take.calibration, take.shape, take.samples_px, self.planner, 0)
        solver, out = method.build(model, take.calibration, self.planner), np.zeros(model.grid.shape, np.float32)
        counts = take.staged.counts
        defects = DefectFinder(take.calibration, take.shape)(counts)
        solver.start(Preparer(take.calibration, model.grid)(counts, None, defects))
        if method.round_pairs:
            for _ in range(solver.rounds):
                solver.step()
        solver.finish(out)
        return take.sampled(to_sensor(out, model.grid))

    def shipped(self, take: "Take") -> tuple[Image, Report]:
        """The picture of the default ladder, as the instrument and `diffuscope reconstruct` climb it, on the samples.

        Quick look, refraction of the eye, then `variation` with the PSF of that eye; no deadline. FrameError for a
        frame that the instrument refuses.
        """
        if self._ladder is None or self._ladder[0] is not take.calibration:
            self._ladder = take.calibration, Reconstructor(take.calibration, take.shape, self.planner, SystemClock())
        made = self._ladder[1](take.staged.counts, simulated=True)
        return take.sampled(made.picture), made.report

    def refraction(self, take: "Take") -> float:
        """The mean sphere that the frame tells, as wavefront in dpt; not a number where it tells none."""
        if self._refractor is None or self._refractor[0] != take.calibration.id:
            found = Refractor(take.calibration, take.shape, self.planner, 0)
            self._refractor = take.calibration.id, found
        refractor, counts = self._refractor[1], take.staged.counts
        eye = refractor.find(counts, None, refractor.defects(counts))
        return float("nan") if eye is None else eye.sphere_dpt

    def tikhonov(self, take: "Take", mu: float) -> Image:
        """The paper's own solution for one weight, on the samples of the scores."""
        return next(iter(self.sweep(take, (mu,))))[1]

    def sweep(self, take: "Take", mus: Iterable[float] = MUS) -> Iterable[tuple[float, Image]]:
        """The paper's own solutions: periodic, without a field, for each weight in turn."""
        calibration = replace(take.staged.calibration, field_deg=None)
        model = periodic_model(calibration, take.shape, take.samples_px, self.planner, 0)
        model.fade = None  # ours for open fields; the paper has none, and its pictures are worse with it
        preparer, out = Preparer(calibration, model.grid), np.zeros(model.grid.shape, np.float32)
        for mu in mus:
            solver = ClosedForm(model, TIKHONOV, mu)
            solver.start(preparer(take.staged.counts))
            solver.finish(out)
            yield mu, take.sampled(to_sensor(out, model.grid))

    def best(self, take: "Take") -> tuple[float, Image, Scores]:
        """The paper's solution with the weight that is nearest to the truth: its visual choice, made by an oracle."""
        mu, picture = max(self.sweep(take), key=lambda found: take.likeness(found[1]))
        return mu, picture, take.score(picture)

    def finest(self, take: "Take") -> tuple[float, Image]:
        """The same with the weight whose details are nearest: what an eye that looks for vessels would choose."""
        return max(self.sweep(take), key=lambda found: take.score(found[1]).highpass_pcc)


@dataclass(frozen=True)
class Take:
    """A frame with its truth, and the samples on which its pictures are scored."""

    name: str
    staged: Staged

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the sensor."""
        rows, cols = self.staged.counts.shape
        return rows, cols

    @property
    def calibration(self) -> Calibration:
        """What the factory measured."""
        return self.staged.calibration

    @property
    def px_per_deg(self) -> float:
        """Samples of the scores per degree."""
        assert self.calibration.geometry is not None
        return self.calibration.geometry.px_per_deg / self.samples_px

    @property
    def samples_px(self) -> int:
        """How many sensor pixels make one sample of the scores, n x n."""
        assert self.calibration.geometry is not None
        return max(1, round(SAMPLE_UM / self.calibration.geometry.pitch_um))

    def sampled(self, image: Image) -> Image:
        """An image on the sensor's pixels, (rows, cols), as means over the samples of the scores."""
        n = self.samples_px
        rows, cols = (size // n for size in image.shape)
        first = [(size - count * n) // 2 for size, count in zip(image.shape, (rows, cols), strict=True)]
        cut = image[first[0] : first[0] + rows * n, first[1] : first[1] + cols * n]
        return np.asarray(cut.reshape(rows, n, cols, n).mean(axis=(1, 3)), np.float32)

    @cached_property
    def truth(self) -> Image:
        """The object on the samples of the scores."""
        return self.sampled(self.staged.truth)

    @cached_property
    def raw(self) -> Image:
        """The frame above black, on the samples of the scores."""
        return self.sampled(self.staged.counts.astype(np.float32) - np.float32(self.calibration.sensor.black_dn))

    @cached_property
    def inside(self) -> Mask:
        """The field less its rim."""
        return self._disc(field_radius_px(self.calibration) / self.samples_px - RIM_PX) > 0.5

    def _disc(self, radius_px: float) -> Image:
        rows, cols = self.truth.shape
        return disc((rows, cols), ((rows - 1) / 2, (cols - 1) / 2), radius_px)

    @cached_property
    def judge(self) -> Judge:
        """The truth inside the field."""
        vessels = self.staged.vessels
        known = None if vessels is None else self.sampled(vessels.astype(np.float32)) > 0.5
        return Judge(self.truth, self.inside, DETAIL_DEG * self.px_per_deg, known)

    def score(self, picture: Image) -> Scores:
        """How near a picture on the samples comes to the truth."""
        return self.judge(picture)

    def likeness(self, picture: Image) -> float:
        """The first of the scores alone: PCC inside the field."""
        return float(np.corrcoef(picture[self.inside], self.truth[self.inside])[0, 1])

    def evened(self, picture: Image) -> Image:
        """After the paper's flat-field correction."""
        field = self._disc(field_radius_px(self.calibration) / self.samples_px)
        return even_out(picture, field, EVEN_DEG * self.px_per_deg)

    def column(self, right_deg: float) -> int:
        """The column of a place on the samples."""
        return round(float((self.truth.shape[1] - 1) / 2 + right_deg * self.px_per_deg))

    def row(self, down_deg: float) -> int:
        """The row of a place on the samples."""
        return round(float((self.truth.shape[0] - 1) / 2 + down_deg * self.px_per_deg))


def changed(spec: InstrumentSpec, changes: Mapping[str, Any]) -> InstrumentSpec:
    """A head with some keys changed, checked as if it had been read; keys are dotted."""
    tree = spec.model_dump()
    for dotted, value in changes.items():
        *tables, key = dotted.split(".")
        table = tree
        for name in tables:
            table = table[name]
        table[key] = value
    return InstrumentSpec.model_validate(tree)


def merged(spec: InstrumentSpec, n: int) -> InstrumentSpec:
    """The same head with n x n pixels read as one: their light, their wells and their noise together."""
    camera = spec.camera
    assert spec.sim is not None
    return changed(
        spec,
        {
            "camera.rows": camera.rows // n, "camera.cols": camera.cols // n, "camera.pitch_um": camera.pitch_um * n,
            "camera.full_well_e": camera.full_well_e * n**2, "camera.read_noise_e": camera.read_noise_e * n,
            "sim.peak_e": spec.sim.peak_e * n**2,
        },
    )  # fmt: skip
