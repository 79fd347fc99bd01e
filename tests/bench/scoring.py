"""Scores of the benchmark and their table row."""

from device.recon.assessment.metrics import PictureScorer
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.grid import disc
from device.sim.scene_files import SimulatedExposure
from device.values import Image
from tests.bench import timing


def judge_of(scene: SimulatedExposure) -> PictureScorer:
    """Return the scorer inside the field, without two pixels at its edge."""
    shape = scene.truth.shape
    middle = ((shape[0] - 1) / 2, (shape[1] - 1) / 2)
    inside = disc(shape, middle, field_radius_px(scene.calibration) - 2) > 0.5
    geometry = scene.calibration.geometry
    return PictureScorer(scene.truth, inside, 2 * geometry.px_per_deg if geometry else 32.0, scene.vessels)


def scored(name: str, ms: float, mb: float, judge: PictureScorer, picture: Image) -> None:
    """Print time, peak memory and scores of one picture."""
    scores = judge(picture)
    timing.row(name, ms, mb, scores.psnr_db, scores.pcc, scores.ssim, scores.highpass_pcc)
