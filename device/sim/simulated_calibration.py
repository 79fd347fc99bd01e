"""Simulated calibration: PSF from sixteen noisy frames of a point source and sixteen dark frames."""

import numpy as np

from device.config.scene import ElementFlaws
from device.optics import lenslets
from device.optics.diffuser import Refraction, steepest_rad
from device.optics.eye import correction_dpt
from device.optics.lit_angle import picture_field_deg, soft_edge_deg
from device.sim.effects.sensor import hot_pixels
from device.sim.optical_setup import OpticalSetup
from device.sim.render import convolved_with_disc, crop_or_pad, psf
from device.sim.sensor import SensorModel
from device.sim.world import World
from device.values import Calibration, Colour, Image, Psf, Sensor

FRAMES = 16
FILL_FRACTION = 0.8  # peak as a fraction of the full well: bright and nowhere saturated


def simulated_calibration(world: World) -> Calibration:
    """Return the simulated calibration of a World's head: PSF, sensor values, geometry; marked as simulated.

    The PSF is float32 (rows, cols) of the sensor, sum 1, centre at (rows//2, cols//2), measured with the eye of
    [sim.calibration] instead of the World's present eye, with the noise of sixteen frames.
    """
    camera = world.spec.camera
    point = calibration_point(world)
    size = min(point.shape[0], camera.rows), min(point.shape[1], camera.cols)
    caustic_e = crop_or_pad(point, size)
    caustic_e *= np.float32(FILL_FRACTION * camera.full_well_e / float(caustic_e.max()))
    pixels = world.sensor.crop_to_centre(size)
    measured = mean_frame(pixels, caustic_e, world.scene.seed, 1)
    measured -= mean_frame(pixels, np.zeros_like(caustic_e), world.scene.seed, 2)
    measured -= _pedestal(measured, world)
    sensor = Sensor(camera.black_dn, camera.gain_e_per_dn, camera.read_noise_e, float(camera.white_dn))
    return Calibration(
        psfs=(Psf(crop_or_pad(measured, world.shape), name="simulated point source"),),
        sensor=sensor,
        geometry=world.geometry,
        flat=flat_frame(world),
        bad=hot_pixels(world.scene) if world.scene.sim.sensor.hot_pixels else None,
        field_deg=picture_field_deg(world.spec),
        simulated=True,
        source_in_focus=True,
        soft_edge_deg=soft_edge_deg(world.spec),
    )


def flat_frame(world: World) -> Image | None:
    """Return the relative response of the pixels, (rows, cols); each of the four Bayer sites has the mean 1.

    A flat field must not amplify what a mosaic attenuates: that would amplify noise. None for a uniform response.
    """
    response = world.setup(world.spec.light.colour).response
    if response is None:
        return None
    flat = response.copy()
    for site in ((slice(row, None, 2), slice(col, None, 2)) for row in (0, 1) for col in (0, 1)):
        flat[site] /= max(float(flat[site].mean(dtype=np.float64)), 1e-30)
    return flat


def calibration_point(world: World, moved_mm: float = 0.0, colour: Colour | None = None) -> Image:
    """Return the noise-free image (n, n) of the calibration's point source, with the values of [sim.calibration].

    A source `moved_mm` farther from the model eye's lens acts as in a longer eye, M = 1/f - 1/s with s = f + moved_mm,
    and appears smaller. `colour` None: the picture's colour.
    """
    setup = world.setup(colour or world.spec.light.colour)
    spec = world.scene.sim.calibration
    eye_mm = world.scene.sim.eye.focal_length_um / 1000
    point_setup = OpticalSetup(setup.scene, setup.subject, setup.sensor, lines=setup.lines)
    longer_dpt = -correction_dpt(eye_mm + moved_mm, eye_mm)
    flaws = setup.lenses.flaws.model_copy(update=ElementFlaws().since)
    point_setup.lenses = lenslets.LensState(flaws, setup.lenses.curved)
    point_setup.refraction = Refraction(spec.m_dpt + longer_dpt, spec.j0_dpt, spec.j45_dpt)
    if spec.diffuser_to_sensor_um is not None:
        point_setup.optics = setup.optics.model_copy(update={"diffuser_to_sensor_um": spec.diffuser_to_sensor_um})
    point = psf(point_setup)
    scale = setup.optics.angular_magnification * setup.optics.diffuser_to_sensor_um
    on_sensor_um = setup.calibrated.source_um * scale / (1000 * (eye_mm + moved_mm))
    return convolved_with_disc(point, on_sensor_um / world.spec.camera.pitch_um) if on_sensor_um else point


def mean_frame(sensor: SensorModel, electrons: Image, seed: int, part: int) -> Image:
    """Return the mean of sixteen noisy frames, counts with black level, float32; `part` selects the random numbers."""
    total = np.zeros(electrons.shape, np.float32)
    counts = np.empty(electrons.shape, np.uint16)
    for number in range(FRAMES):
        total += sensor.read(electrons, (seed, 0, part, number), counts)
    total /= FRAMES
    return total


def _pedestal(image: Image, world: World) -> np.float32:
    """Return the mean of the pixels beyond the reach of the caustic, the residual offset after dark subtraction.

    0 if the caustic reaches every pixel.
    """
    optics = world.scene.optics
    if optics.element.kind == "lenslets":
        reach_um = lenslets.reach_um(optics)
    else:
        reach_um = optics.iris_um / 2 + optics.diffuser_to_sensor_um * steepest_rad(optics)
    rows, cols = (np.arange(size, dtype=np.float32) - size // 2 for size in image.shape)
    outside = np.hypot(rows[:, None], cols[None, :]) * np.float32(world.geometry.pitch_um) > reach_um
    return np.float32(image[outside].mean(dtype=np.float64)) if outside.any() else np.float32(0)
