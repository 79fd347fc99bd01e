"""What the factory would measure of a simulated head: a point source, sixteen frames, and their dark."""

import numpy as np

from device.optics.diffuser import Refraction, steepest_rad
from device.optics.eye import correction_dpt
from device.sim.effects.hot import hot_pixels
from device.sim.render import dotted, fitted, psf
from device.sim.sensor import SensorModel
from device.sim.setup import Setup
from device.sim.world import World
from device.values import Calibration, Colour, Image, Psf, Sensor

FRAMES = 16
FILLED = 0.8  # of the full well: bright, and nowhere saturated


def simulated_calibration(world: World) -> Calibration:
    """Measure the head of a world as the factory does: PSF, sensor values, geometry; marked as simulated.

    The PSF is float32 (rows, cols) of the sensor, sum 1, centre at (rows//2, cols//2). It was measured with the
    eye of [sim.calibration], whatever the eye in the world is now, and it carries the noise of sixteen frames.
    """
    camera = world.spec.camera
    point = calibration_point(world)
    size = min(point.shape[0], camera.rows), min(point.shape[1], camera.cols)
    caustic_e = fitted(point, size)
    caustic_e *= np.float32(FILLED * camera.full_well_e / float(caustic_e.max()))
    pixels = world.sensor.middle(size)
    measured = mean_frame(pixels, caustic_e, world.seed, 1)
    measured -= mean_frame(pixels, np.zeros_like(caustic_e), world.seed, 2)
    measured -= _pedestal(measured, world)
    sensor = Sensor(camera.black_dn, camera.gain_e_per_dn, camera.read_noise_e, float(camera.white_dn))
    return Calibration(
        psfs=(Psf(fitted(measured, world.shape), name="simulated point source"),),
        sensor=sensor,
        geometry=world.geometry,
        flat=flat_frame(world),
        bad=hot_pixels(world.scene) if world.scene.sim.sensor.hot_pixels else None,
        field_deg=world.optics.field_deg,
        simulated=True,
    )


def flat_frame(world: World) -> Image | None:
    """How the pixels respond, (rows, cols); each of a colour mosaic's four sites relative to its own mean.

    What a mosaic keeps away must not be made up for: it would be noise. None for pixels that are all alike.
    """
    response = world.setup(world.spec.light.colour).response
    if response is None:
        return None
    flat = response.copy()
    for site in ((slice(row, None, 2), slice(col, None, 2)) for row in (0, 1) for col in (0, 1)):
        flat[site] /= max(float(flat[site].mean(dtype=np.float64)), 1e-30)
    return flat


def calibration_point(world: World, moved_mm: float = 0.0, colour: Colour | None = None) -> Image:
    """What the point source of the factory becomes: another eye, another distance, and a dot of some size.

    `moved_mm` away from the lens of the model eye it is that of a longer eye: M = 1/f - 1/s, and looks smaller.
    """
    setup, said = world.setup(colour or world.spec.light.colour), world.scene.sim.calibration
    eye_mm = world.scene.sim.eye.focal_length_um / 1000
    there = Setup(setup.scene, setup.subject, setup.sensor, lines=setup.lines)
    longer_dpt = -correction_dpt(eye_mm + moved_mm, eye_mm)
    there.refraction = Refraction(said.m_dpt + longer_dpt, said.j0_dpt, said.j45_dpt)
    if said.diffuser_to_sensor_um is not None:
        there.optics = setup.optics.model_copy(update={"diffuser_to_sensor_um": said.diffuser_to_sensor_um})
    point = psf(there)
    scale = setup.optics.angular_magnification * setup.optics.diffuser_to_sensor_um
    on_sensor_um = setup.source_um * scale / (1000 * (eye_mm + moved_mm))
    return dotted(point, on_sensor_um / world.spec.camera.pitch_um) if on_sensor_um else point


def mean_frame(sensor: SensorModel, electrons: Image, seed: int, part: int) -> Image:
    """The mean of sixteen frames in counts, float32; only the sensor itself clips before the average."""
    total = np.zeros(electrons.shape, np.float32)
    counts = np.empty(electrons.shape, np.uint16)
    for number in range(FRAMES):
        total += sensor.read(electrons, (seed, 0, part, number), counts)
    total /= FRAMES
    return total


def _pedestal(image: Image, world: World) -> np.float32:
    """The mean of the pixels that the caustic cannot reach: what no dark frame took away; 0 if there are none."""
    optics = world.optics
    reach_um = optics.iris_um / 2 + optics.diffuser_to_sensor_um * steepest_rad(optics)
    rows, cols = (np.arange(size, dtype=np.float32) - size // 2 for size in image.shape)
    outside = np.hypot(rows[:, None], cols[None, :]) * np.float32(world.geometry.pitch_um) > reach_um
    return np.float32(image[outside].mean(dtype=np.float64)) if outside.any() else np.float32(0)
