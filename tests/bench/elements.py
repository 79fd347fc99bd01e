"""`make bench-elements`: picture, refraction and time behind each element at the iris, at the light of a human eye.

Means over a drawn eye and photographs; the default solver with the calibrated PSF, pixels of 6.9 um, no deadline. The
field of view that all heads have is scored; the high-power ring lights a wider one. The stated limits are those of
lenslets; exit status 1 if one fails.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import radians
from pathlib import Path
from typing import NamedTuple

import numpy as np

from device.clock import VirtualClock
from device.errors import FrameError
from device.recon.assessment.metrics import PictureScorer
from device.recon.burst_reconstructor import BurstReconstructor
from device.recon.model.fft_plans import Planner
from device.recon.reconstructor import Reconstructor
from device.sim.fundus import field_mask
from device.sim.photo import photograph
from device.sim.render import crop_or_pad
from device.sim.scene_files import lit_frames
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Counts, Mask, Reconstruction
from tests.bench.element_scenes import HEADS, Eye, behind_pupil, light_in_pupil, scene, world
from tests.bench.ring_correlation import resolution_lp_per_mm

DETAIL_DEG, RIM_PX = 2.0, 3.0  # high-pass filter, and edge of the field that is left out
PLANNER = Planner(folder=None, effort="FFTW_ESTIMATE")


class Figures(NamedTuple):
    """Scores of one picture, NaN where unknown: PCC, PSNR, high-pass PCC, vessel contrast over the truth's, detail.

    `error_dpt` is the error of the mean sphere, `cpu_s` the processor time of the picture.
    """

    pcc: float
    psnr_db: float
    highpass_pcc: float
    vessel_contrast: float
    lp_per_mm: float
    error_dpt: float
    cpu_s: float


NONE = Figures(*[float("nan")] * 7)
PRINTED = {"pcc": ".3f", "psnr_db": ".1f", "highpass_pcc": ".3f", "vessel_contrast": ".3f", "lp_per_mm": ".1f"}


@dataclass(frozen=True)
class Take:
    """Frames of one eye behind one element, with the calibration of the head."""

    world: World
    vessels: Mask | None
    frames: tuple[Counts, ...]

    @classmethod
    def of(cls, world: World, vessels: Path | None, count: int) -> "Take":
        """Return `count` frames of a world; `vessels`: mask of the vessels of its photograph."""
        mask = world.retina.vessels
        if vessels is not None:
            (rows, cols), px_per_deg = world.retina.field.shape, world.geometry.px_per_deg
            mask = photograph(vessels, (rows, cols), px_per_deg, world.scene.lit_deg).plane("green") > 0.5
        seen = None if mask is None else crop_or_pad(mask.astype(np.float32), world.shape) > 0.5
        return cls(world, seen, lit_frames(world, count))

    def figures(self) -> Figures:
        """Return the scores of the picture of all frames, by the default solver."""
        calibration = simulated_calibration(self.world)
        single = Reconstructor(calibration, self.world.shape, PLANNER, VirtualClock(), timed=False)
        begin_s = time.process_time()
        try:
            made = solved(single, self.frames)
        except FrameError:
            return NONE
        cpu_s = time.process_time() - begin_s
        truth = self.world.truth(self.world.spec.light.colour)
        radius_px = self.world.scene.half_field_deg * self.world.geometry.px_per_deg
        inside = np.asarray(field_mask(truth.shape, radius_px - RIM_PX))
        judge = PictureScorer(truth, inside, DETAIL_DEG * self.world.geometry.px_per_deg, self.vessels)
        scores, eye = judge(made.picture), self.world.scene.sim.eye
        contrast = float("nan") if scores.vessel_contrast is None else scores.vessel_contrast
        px_per_mm = self.world.geometry.px_per_deg / (radians(1) * eye.focal_length_um / 1000)
        sphere = (made.report.refraction_dpt or {}).get("sphere")
        return Figures(
            scores.pcc,
            scores.psnr_db,
            scores.highpass_pcc,
            contrast / (judge.truth_contrast or float("nan")),
            resolution_lp_per_mm(made.picture, truth, radius_px, px_per_mm),
            -sphere - eye.m_dpt if isinstance(sphere, float) else float("nan"),
            cpu_s,
        )


def solved(single: Reconstructor, frames: Sequence[Counts]) -> Reconstruction:
    """Return the picture of a frame, or of a burst; FrameError if it is refused, or if not all frames are joined."""
    if len(frames) == 1:
        return single(frames[0], simulated=True)
    *_, made = BurstReconstructor(single, PLANNER, timed=False).steps(frames, None, simulated=True)
    assert isinstance(made, Reconstruction)
    if sum(use.used for use in made.report.frames or ()) != len(frames):
        raise FrameError("not all frames were joined")
    return made


def row(head: str, count: int, found: Sequence[Figures]) -> str:
    """Return the line of the table of a head: means over the eyes, error of each refraction, least time."""
    means = [format(np.nanmean([getattr(figures, name) for figures in found]), form) for name, form in PRINTED.items()]
    errors = " ".join("-" if np.isnan(figures.error_dpt) else f"{figures.error_dpt:+.2f}" for figures in found)
    least_s = np.nanmin([figures.cpu_s for figures in found])
    return f"| {head} | {count} | {' | '.join(means)} | {errors} | {least_s:.1f} |"


LIMITS = {
    ("lenslets", 1): {"pcc": 0.98, "highpass_pcc": 0.95, "vessel_contrast": 0.78, "lp_per_mm": 10.5},
    ("lenslets, power", 1): {"highpass_pcc": 0.978},
    ("lenslets", 4): {"highpass_pcc": 0.972},
}  # with flat fields, 0 dpt


def misses(head: str, count: int, found: Sequence[Figures]) -> Iterator[str]:
    """Yield a line for each mean that is below its limit."""
    for name, limit in LIMITS.get((head, count), {}).items():
        mean = float(np.nanmean([getattr(figures, name) for figures in found]))
        if not mean >= limit:
            yield f"MISS {head}, {count} frames: {name} {mean:.3f} (at least {limit:g})"


def main() -> None:
    """Print the table; exit status 1 if a limit fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.elements", description=__doc__)
    parser.add_argument("--photo", type=Path, nargs="*", default=[], help="photographs beside the drawn eye")
    parser.add_argument("--vessels", type=Path, nargs="*", default=[], help="masks of their vessels, in their order")
    parser.add_argument("--heads", nargs="*", choices=list(HEADS), default=list(HEADS))
    parser.add_argument("--frames", type=int, nargs="*", default=[1, 4])
    parser.add_argument("--m-dpt", type=float, default=0.0, help="mean sphere of the eyes; above 0: myopia")
    parser.add_argument("--pupil-mm", type=float, help="of the eyes, with the light of a wide one on their retinas")
    parser.add_argument("--decentred-mm", type=float, default=0.0, help="distance of that pupil from the axis")
    parser.add_argument("--curved", action="store_true", help="each lens is a thin plate with a curved image surface")
    asked = parser.parse_args()
    masks = [None, *asked.vessels, *[None] * (len(asked.photo) - len(asked.vessels))]
    eyes = [Eye(asked.m_dpt, photo=photo) for photo in (None, *asked.photo)]
    names = ", ".join("drawn" if eye.photo is None else eye.photo.stem for eye in eyes)
    print(f"{names}; M {asked.m_dpt:+g} dpt; {'curved' if asked.curved else 'flat'} fields")
    print("| element | frames | PCC | PSNR, dB | HP | VC | lp/mm | error of M, dpt | CPU, s |")
    print("|---|---|---|---|---|---|---|---|---|")
    missed = []
    for head in asked.heads:
        worlds = [world(scene(head, eye), is_flat=not asked.curved) for eye in eyes]
        if asked.pupil_mm:
            specs = [behind_pupil(wide, 1000 * asked.pupil_mm, 1000 * asked.decentred_mm) for wide in worlds]
            worlds = [world(spec, is_flat=not asked.curved) for spec in specs]
            print(f"{head}: {light_in_pupil(specs[0]):.0%} of the ring's light enters the pupil")
        takes = [Take.of(each, mask, max(asked.frames)) for each, mask in zip(worlds, masks, strict=True)]
        for count in asked.frames:
            found = [replace(take, frames=take.frames[:count]).figures() for take in takes]
            print(row(head, count, found), flush=True)
            if not asked.curved and not asked.m_dpt:
                missed += misses(head, count, found)
    print("\n".join(missed))
    raise SystemExit(bool(missed))


if __name__ == "__main__":
    main()
