"""The judge of the bench, and a row of its verdict."""

from device.recon.geometry import disc
from device.recon.metrics import Judge
from device.recon.model import field_radius_px
from device.sim.staged import Staged
from device.values import Image
from tests.bench import timing


def judge_of(scene: Staged) -> Judge:
    """Scores inside the field, two pixels off its rim."""
    shape = scene.truth.shape
    middle = ((shape[0] - 1) / 2, (shape[1] - 1) / 2)
    inside = disc(shape, middle, field_radius_px(scene.calibration) - 2) > 0.5
    geometry = scene.calibration.geometry
    return Judge(scene.truth, inside, 2 * geometry.px_per_deg if geometry else 32.0, scene.vessels)


def scored(name: str, ms: float, mb: float, judge: Judge, picture: Image) -> None:
    """Time, peak memory and scores of one picture."""
    scores = judge(picture)
    timing.row(name, ms, mb, scores.psnr_db, scores.pcc, scores.ssim, scores.highpass_pcc)
