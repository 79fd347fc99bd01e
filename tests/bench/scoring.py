"""Scores of the benchmark and their table row."""

from device.recon.assessment.metrics import PictureScorer
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.grid import disc
from device.sim.scene_files import SimulatedExposure
from device.values import Calibration, Image, Mask
from tests.bench import timing


def judge_of(scene: SimulatedExposure) -> PictureScorer:
    """Return the scorer inside the field, without two pixels at its edge."""
    return judge_of_truth(scene.truth, scene.vessels, scene.calibration)


def judge_of_truth(truth: Image, vessels: Mask | None, calibration: Calibration) -> PictureScorer:
    """Return the scorer of a truth of the whole sensor inside the field, without two pixels at its edge."""
    middle = ((truth.shape[0] - 1) / 2, (truth.shape[1] - 1) / 2)
    inside = disc(truth.shape, middle, field_radius_px(calibration) - 2) > 0.5
    geometry = calibration.geometry
    return PictureScorer(truth, inside, 2 * geometry.px_per_deg if geometry else 32.0, vessels)


def scored(name: str, ms: float, mb: float, judge: PictureScorer, picture: Image) -> None:
    """Print time, peak memory and scores of one picture."""
    scores = judge(picture)
    timing.row(name, ms, mb, scores.psnr_db, scores.pcc, scores.ssim, scores.highpass_pcc)
