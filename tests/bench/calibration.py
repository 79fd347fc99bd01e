"""A whole calibration at full sensor size, compared with the simulator's true values."""

import tempfile
from pathlib import Path

import numpy as np

from device.clock import SystemClock, VirtualClock
from device.config.head_file import load_head
from device.recon.assessment.metrics import PictureScorer
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_radius_px
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.sim.camera import SimCamera
from device.sim.effects.sensor import hot_pixels
from device.sim.light import SimLight
from device.sim.render import crop_or_pad
from device.sim.simulated_calibration import flat_frame
from device.sim.world import World
from device.values import Calibration, ExposureSettings, Illumination, Psf, Sensor
from services.instrument.calibration_request import CalibrationRequest
from services.workshop.calibrate_head import calibrate
from tests.bench.dioptres import MAX_RMS_DPT, factors, refracted
from tests.simulated import with_keys

HEAD = Path("hardware/heads/sim.toml")
FLAWS = {"prnu": 0.01, "dsnu_e": 2.0, "dark_e_per_s": 50.0, "hot_pixels": 1e-4, "nonlinearity": -0.01}


def calibration(planner: Planner) -> None:
    """Print each figure with its limit; AssertionError for a figure beyond its limit."""
    spec, clock = with_keys(load_head(HEAD), sensor=FLAWS), SystemClock()
    begin_s = clock.now_s()
    with tempfile.TemporaryDirectory() as folder:
        request = CalibrationRequest(Path(folder), "D-1", "bench", None, dioptres=True)
        found = calibrate(spec, request, VirtualClock(), print, lambda line: None).calibration
    print(f"\ncalibration of {found.psfs[0].shape}: {clock.now_s() - begin_s:.1f} s of work beside the exposures")
    world, camera = World(spec, VirtualClock()), spec.camera
    truth = true_calibration(world)
    sensor, hot = found.sensor, truth.bad
    assert found.flat is not None
    assert found.bad is not None
    assert truth.flat is not None
    assert hot is not None
    assert sensor.gain_e_per_dn is not None
    assert sensor.read_noise_e is not None
    assert found.geometry is not None
    psf, light = found.psfs[0].pixels, truth.psfs[0].pixels
    beyond = light < 1e-6 * light.max()
    by_found, by_truth = pictures(world, found, truth, planner)
    figures = [
        ("gain, relative error", abs(sensor.gain_e_per_dn / camera.gain_e_per_dn - 1), 0.01),
        ("read noise, relative error", abs(sensor.read_noise_e / camera.read_noise_e - 1), 0.05),
        ("black, DN", abs(sensor.black_dn - camera.black_dn), 0.2),
        ("PRNU, 1 - correlation", 1 - np.corrcoef(found.flat[~hot], truth.flat[~hot])[0, 1], 0.05),
        ("hot pixels missed", float((hot & ~found.bad).sum()), 0.0),
        ("false hot pixels", float((found.bad & ~hot).mean()), 1e-4),
        ("PSF, 1 - correlation", 1 - np.corrcoef(psf.ravel(), light.ravel())[0, 1], 1e-3),
        ("pedestal left, of the mass", abs(float(psf[beyond].sum(dtype=np.float64))), 0.005),
        (f"loss of PSNR, dB (of {by_truth:.2f})", by_truth - by_found, 0.2),
        ("factor: the paper's", abs(found.geometry.scale_per_dpt / world.geometry.nominal_scale_per_dpt - 1), 0.01),
        ("refraction with it, dpt RMS", refracted(spec, found, planner), MAX_RMS_DPT),
        *factors(spec, planner),
    ]
    for name, value, limit in figures:
        print(f"{name:<34} {value:>10.2g}   limit {limit:g}")
    assert all(value <= limit for _, value, limit in figures)


def true_calibration(world: World) -> Calibration:
    """Return the perfect calibration of this head."""
    camera = world.spec.camera
    range_dn = camera.white_dn - camera.black_dn
    bend_per_dn = FLAWS["nonlinearity"] / range_dn
    sensor = Sensor(camera.black_dn, camera.gain_e_per_dn, camera.read_noise_e, camera.white_dn, bend_per_dn)
    psf = Psf(crop_or_pad(world.psf(world.spec.light.colour), world.shape))
    dark_dn = camera.black_dn + FLAWS["dark_e_per_s"] * camera.exposure_s / camera.gain_e_per_dn
    dark = np.full(world.shape, dark_dn, np.float32)
    field_deg, hot = world.scene.optics.field_deg, hot_pixels(world.scene)
    return Calibration((psf,), sensor, world.geometry, field_deg, dark, flat_frame(world), hot)


def pictures(world: World, found: Calibration, truth: Calibration, planner: Planner) -> tuple[float, float]:
    """Return the PSNR in dB of one frame's picture with the measured and with the perfect calibration."""
    colour = world.spec.light.colour
    with SimLight(world).on(Illumination(colour)):
        counts = SimCamera(world).expose(ExposureSettings(world.spec.camera.exposure_s)).counts
    rows, cols = (np.arange(size) - size // 2 for size in world.shape)
    inside = np.hypot(rows[:, None], cols) < 0.95 * field_radius_px(found)
    judge, recipes = PictureScorer(world.truth(colour), inside, 8.0), (Recipe("gradient", 1),)
    made = (
        Reconstructor(candidate, world.shape, planner, VirtualClock(), recipes)(counts) for candidate in (found, truth)
    )
    by_found, by_truth = (judge(reconstruction.picture).psnr_db for reconstruction in made)
    return by_found, by_truth
