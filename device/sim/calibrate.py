"""What the factory would measure of a simulated head: a point source, sixteen frames, and their dark."""

import numpy as np

from device.optics.diffuser import EMMETROPIA, steepest_rad
from device.sim.sensor import SensorModel
from device.sim.world import World, fitted
from device.values import Calibration, Image, Psf, Sensor

FRAMES = 16
FILLED = 0.8  # of the full well: bright, and nowhere saturated


def simulated_calibration(world: World) -> Calibration:
    """Measure the head of a world as the factory does: PSF, sensor values, geometry; marked as simulated.

    The PSF is float32 (rows, cols) of the sensor, sum 1, centre at (rows//2, cols//2). It was measured with a relaxed
    eye, whatever the eye in the world is now, and it carries the noise of sixteen frames.
    """
    camera = world.spec.camera
    point = world.psf(world.spec.light.colour, EMMETROPIA)
    size = min(point.shape[0], camera.rows), min(point.shape[1], camera.cols)
    caustic_e = fitted(point, size)
    caustic_e *= np.float32(FILLED * camera.full_well_e / float(caustic_e.max()))
    measured = mean_frame(world.sensor, caustic_e, world.seed, 1)
    measured -= mean_frame(world.sensor, np.zeros_like(caustic_e), world.seed, 2)
    measured -= _pedestal(measured, world)
    sensor = Sensor(camera.black_dn, camera.gain_e_per_dn, camera.read_noise_e, float(camera.white_dn))
    return Calibration(
        psfs=(Psf(fitted(measured, world.shape), name="simulated point source"),),
        sensor=sensor,
        geometry=world.geometry,
        field_deg=world.optics.field_deg,
        simulated=True,
    )


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
