"""Pictures and refraction behind lenslets from textbook frames, beside those from the simulator's frames.

The textbook's wave crosses the whole iris at once, its scene is a numpy array, its blur a linear convolution and its
calibration the mean of noisy frames: no code of `device/optics` or `device/sim`.
"""

from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from PIL import Image as Photograph

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.config.scene import ObjectSpec
from device.recon.assessment.metrics import PictureScorer, Scores
from device.recon.model.grid import disc
from device.recon.reconstructor import Reconstructor
from device.sim.plan import decide
from device.sim.scene_files import simulate_exposure
from device.values import Calibration, Counts, Image, Psf, Sensor
from tests.scenes import PLANNER
from tests.simulated import SCENES, coarse
from tests.textbook.fundus_frame import Camera, FieldEdge, blurred, degrees
from tests.textbook.propagation import Optics, Plane, Prescription, caustic

PITCH_UM, FINER, SAMPLES = 6.9, 3, 1536  # of the sensor, and of the wave: 2.3 um
PEAK_E, POINT_E, POINT_FRAMES = 800.0, 30000.0, 16
CAMERA = Camera((544, 728), 40000.0, 4.4, 12, 60.0)
FIELD_DEG, DETAIL_DEG, RIM_PX = 33.4, 2.0, 3.0
WAVELENGTHS_UM = (0.53, 0.54, 0.55, 0.56, 0.57)
SIGNS = {"sphere": -1, "j0": -1, "j45": 1}  # of the wavefront, down, over those of the lens, whose axis is upwards
Eye = tuple[float, float, float]


def head() -> InstrumentSpec:
    return load_head(SCENES / "human_eye_imx296_lenslets.toml")


def retina(size: int) -> Plane:
    """Return a bright disc in shaded tissue with dark crooked vessels, 0 to 1, (size, size)."""
    rng = np.random.default_rng(3)
    down, right = np.mgrid[:size, :size] / size - 0.5
    plane = 0.6 - 0.5 * (right**2 + down**2) + 0.3 * np.exp(-((right - 0.2) ** 2 + down**2) / 0.002)
    for width in np.geomspace(2e-3, 1e-2, 40):
        (across, along), angle = rng.uniform(-0.4, 0.4, 2), rng.uniform(0, np.pi)
        u = (right - across) * np.cos(angle) + (down - along) * np.sin(angle)
        v = (down - along) * np.cos(angle) - (right - across) * np.sin(angle)
        bend = 0.03 * np.sin(rng.uniform(8, 30) * u + rng.uniform(0, 6))
        plane *= 1 - 0.35 * np.exp(-(((v - bend) / width) ** 2)) * (np.abs(u) < rng.uniform(0.1, 0.4))
    return np.asarray(plane)


def textbook_psf(eye: Eye) -> Plane:
    """Return the PSF of an eye on the sensor; each place of the iris has the thin parabolic lens nearest to it."""
    spec = head().optics
    assert spec is not None
    across_um = (np.arange(SAMPLES) - SAMPLES // 2) * PITCH_UM / FINER
    squares = [(across_um[None] - x) ** 2 + (across_um[:, None] - y) ** 2 for x, y, _ in spec.element.lenses]
    nearest, focal_um = np.argmin(squares, axis=0), np.array([focal for *_, focal in spec.element.lenses])
    path_um = -np.min(squares, axis=0) / (2 * focal_um[nearest])
    m_dpt, j0_dpt, j45_dpt = eye
    glasses = Prescription.of_power_vector(-m_dpt, -j0_dpt, j45_dpt)  # whose axis is counted upwards
    fine = caustic(Optics(PITCH_UM / FINER, wavelengths_um=WAVELENGTHS_UM), path_um, glasses)
    middle = np.roll(fine, FINER // 2, (0, 1))  # the axis is in the middle of a pixel
    return np.asarray(middle.reshape(SAMPLES // FINER, FINER, -1, FINER).sum(axis=(1, 3)))


def textbook_calibration() -> Calibration:
    spec = head().optics
    assert spec is not None
    point, rng = np.pad(textbook_psf((0.0, 0.0, 0.0)), ((16, 16), (108, 108))), np.random.default_rng(7)
    point *= POINT_E / point.max()
    frames = [CAMERA.read(point, rng).astype(np.float64) for _ in range(POINT_FRAMES)]
    measured = np.mean(frames, axis=0) - CAMERA.black_dn
    sensor = Sensor(CAMERA.black_dn, CAMERA.gain_e_per_dn, CAMERA.read_noise_e, 2.0**CAMERA.bits - 1)
    return Calibration((Psf(measured.astype(np.float32)),), sensor, spec.geometry(PITCH_UM), field_deg=FIELD_DEG)


def scored(calibration: Calibration, counts: Counts, truth: Image) -> tuple[Scores, list[float]]:
    """Return the scores of the default picture, and M, J0, J45 as wavefront."""
    made = Reconstructor(calibration, counts.shape, PLANNER, VirtualClock())(counts, simulated=True)
    assert calibration.geometry is not None
    px_per_deg = calibration.geometry.px_per_deg
    middle = ((truth.shape[0] - 1) / 2, (truth.shape[1] - 1) / 2)
    inside = disc(truth.shape, middle, FIELD_DEG / 2 * px_per_deg - RIM_PX) > 0.5
    found = made.report.refraction_dpt
    assert found is not None
    assert found["refused"] is None
    eye = [sign * cast(float, found[name]) for name, sign in SIGNS.items()]
    return PictureScorer(truth, inside, DETAIL_DEG * px_per_deg)(made.picture), eye


@pytest.mark.parametrize("eye", [(0.0, 0.0, 0.0), (-4.0, 0.5, -0.3)], ids=str)
def test_textbook_frames_give_the_same_picture_and_refraction(eye: Eye, tmp_path: Path) -> None:
    spec = coarse(head(), 2)
    assert spec.sim is not None
    optics = Optics(PITCH_UM)
    size = round(optics.px_per_deg * FIELD_DEG)
    scene = retina(size)
    lit = scene * FieldEdge(FIELD_DEG).light(*degrees(optics, size))
    light = blurred(lit, textbook_psf(eye), CAMERA.shape)
    counts = CAMERA.read(light / light.max() * PEAK_E, np.random.default_rng(11))
    truth = blurred(lit, np.pad(np.ones((1, 1)), 1), CAMERA.shape).astype(np.float32)
    ours, our_eye = scored(textbook_calibration(), counts, truth)

    photo = tmp_path / "retina.png"
    Photograph.fromarray((scene * 65535).astype(np.uint16)).save(photo)
    m_dpt, j0_dpt, j45_dpt = eye
    changes = {
        "object": ObjectSpec(kind="image", image=photo),
        "eye": spec.sim.eye.model_copy(update={"m_dpt": m_dpt, "j0_dpt": j0_dpt, "j45_dpt": j45_dpt}),
        "peak_e": PEAK_E,
    }
    spec = spec.model_copy(update={"sim": spec.sim.model_copy(update=changes)})
    exposure = simulate_exposure(spec, partial(decide, without=("lens_curvature",)))
    theirs, their_eye = scored(exposure.calibration, exposure.counts, exposure.truth)
    assert ours.highpass_pcc == pytest.approx(theirs.highpass_pcc, abs=0.01)
    assert ours.pcc == pytest.approx(theirs.pcc, abs=0.01)
    assert our_eye == pytest.approx(eye, abs=0.06)
    assert their_eye == pytest.approx(eye, abs=0.06)
