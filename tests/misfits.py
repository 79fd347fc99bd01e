"""A head that is no longer as it was calibrated: its diffuser turned, moved, swapped; its sensor hot or offset."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy import ndimage

from device.clock import VirtualClock
from device.optics.diffuser import Beam, Refraction, caustic_on, grid_for
from device.sim.calibrate import simulated_calibration
from device.sim.render import blurred, traced
from device.sim.world import World
from device.spec import load_head
from device.values import Calibration, Counts, Image
from tests.simulated import coarse, having

HEAD = Path(__file__).parents[1] / "hardware" / "heads" / "sim.toml"
K = 4  # x 4 pixels of the paper's sensor as one: the caustic's band is within


@cache
def world(seed: int = 1) -> World:
    """The head with another retina; whose diffuser it has is said by `point`."""
    return World(having(coarse(load_head(HEAD), K), seed=seed), VirtualClock())


@cache
def calibrated() -> Calibration:
    """The head as the factory left it."""
    return simulated_calibration(world())


def point(m_dpt: float = 0.0, diffuser: int = 1, turned_deg: float = 0.0, z_um: float = 6000.0) -> Image:
    """The caustic of an eye behind a diffuser that may be another, turned, or at another distance."""
    optics = world().optics.model_copy(update={"diffuser_to_sensor_um": z_um})
    caustic = traced(optics, world().geometry.pitch_um, diffuser, Refraction(m_dpt), 1, None)
    if not turned_deg:
        return caustic
    return np.asarray(ndimage.rotate(np.pad(caustic, 4), turned_deg, reshape=False, order=3), np.float32)


def lit(point: Image, retina: int = 1, light: float = 1.0, noise: int = 0) -> Counts:
    """One frame of a retina through a caustic, at a share of the usual light."""
    return lit_by(world(retina).retina.reflectance["green"], point, light, noise)


def lit_by(retina: Image, point: Image, light: float = 1.0, noise: int = 0) -> Counts:
    """The same of any retina on the sensor's grid."""
    arriving = blurred([(retina, point)], world().shape)
    peak_e = world().scene.sim.peak_e * light
    return world().sensor.read(arriving * np.float32(peak_e / arriving.max()), (9, noise))


def dark(black_dn: float = 0.0, hot: float = 0.0, noise: int = 0) -> Counts:
    """One dark frame; so much brighter, and with that share of pixels full."""
    sensor = replace(world().sensor, black_dn=world().sensor.black_dn + black_dn)
    counts = sensor.read(np.zeros(world().shape, np.float32), (8, noise))
    counts[np.random.default_rng(41).random(counts.shape) < hot] = sensor.white_dn
    return counts


def slid(by_um: float) -> Image:
    """The caustic where the diffuser was pushed aside behind its iris: another part of its surface."""
    optics, pitch_um = world().optics, world().geometry.pitch_um
    wide = optics.model_copy(update={"iris_um": optics.iris_um + 2 * by_um})
    beam = Beam(by_um, 0.0, optics.iris_um / 2)
    caustic = caustic_on(grid_for(optics, pitch_um), wide, 1, lines=1, beam=beam)
    return np.roll(caustic, -round(by_um / pitch_um), 1)


def farther(by_um: float) -> Counts:
    """A frame with the sensor so much farther from the diffuser: the caustic changes little, the picture grows."""
    z_um = world().optics.diffuser_to_sensor_um + by_um
    optics = world().optics.model_copy(update={"diffuser_to_sensor_um": z_um})
    there = world().spec.model_copy(update={"optics": optics})
    return lit_by(World(there, VirtualClock()).retina.reflectance["green"], point(z_um=z_um))


def aside(by_deg: float) -> Counts:
    """A frame on a sensor that has moved to the right; or whose lamp has, it is the same."""
    return np.roll(lit(point()), round(by_deg * world().geometry.px_per_deg), 1)
