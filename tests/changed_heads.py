"""Simulated heads that differ from their calibration: diffuser rotated, moved or exchanged; sensor hot or offset."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy import ndimage

from device.clock import VirtualClock
from device.config.head_file import load_head
from device.optics.diffuser import Beam, Refraction, caustic_on, grid_for
from device.sim.render import cached_psf, convolved
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Calibration, Counts, Image
from tests.simulated import coarse, with_keys

HEAD = Path(__file__).parents[1] / "hardware" / "heads" / "sim.toml"
K = 4  # x 4 pixels of the paper's sensor per pixel; the band of the caustic is still sampled


@cache
def world(seed: int = 1) -> World:
    """Return the simulated head with retina `seed`; the diffuser is chosen by `caustic_of_eye`."""
    return World(with_keys(coarse(load_head(HEAD), K), seed=seed), VirtualClock())


@cache
def calibrated() -> Calibration:
    """Return the calibration of the unchanged head."""
    return simulated_calibration(world())


def caustic_of_eye(m_dpt: float = 0.0, diffuser: int = 1, turned_deg: float = 0.0, z_um: float = 6000.0) -> Image:
    """Return the caustic of an eye with mean sphere `m_dpt` for another, rotated or moved diffuser."""
    optics = world().scene.optics.model_copy(update={"diffuser_to_sensor_um": z_um})
    caustic = cached_psf(optics, world().geometry.pitch_um, diffuser, Refraction(m_dpt), 1, None)
    if not turned_deg:
        return caustic
    return np.asarray(ndimage.rotate(np.pad(caustic, 4), turned_deg, reshape=False, order=3), np.float32)


def frame_through(point: Image, retina: int = 1, light: float = 1.0, noise: int = 0) -> Counts:
    """Return one frame of a retina through a caustic, with `light` as a share of the usual light."""
    return frame_of_retina(world(retina).retina.reflectance["green"], point, light, noise)


def frame_of_retina(retina: Image, point: Image, light: float = 1.0, noise: int = 0) -> Counts:
    """Return the frame of any retina on the sensor's grid through a caustic."""
    arriving = convolved([(retina, point)], world().shape)
    peak_e = world().scene.sim.peak_e * light
    return world().sensor.read(arriving * np.float32(peak_e / arriving.max()), (9, noise))


def dark(black_dn: float = 0.0, hot: float = 0.0, noise: int = 0) -> Counts:
    """Return one dark frame, `black_dn` brighter and with the share `hot` of its pixels at the white level."""
    sensor = replace(world().sensor, black_dn=world().sensor.black_dn + black_dn)
    counts = sensor.read(np.zeros(world().shape, np.float32), (8, noise))
    counts[np.random.default_rng(41).random(counts.shape) < hot] = sensor.white_dn
    return counts


def caustic_of_shifted_diffuser(by_um: float) -> Image:
    """Return the caustic of a diffuser that is shifted behind its iris, so that another part of its surface is lit."""
    optics, pitch_um = world().scene.optics, world().geometry.pitch_um
    wide = optics.model_copy(update={"iris_um": optics.iris_um + 2 * by_um})
    beam = Beam(by_um, 0.0, optics.iris_um / 2)
    caustic = caustic_on(grid_for(optics, pitch_um), wide, 1, lines=1, beam=beam)
    return np.roll(caustic, -round(by_um / pitch_um), 1)


def frame_at_larger_distance(by_um: float) -> Counts:
    """Return a frame with the sensor `by_um` farther from the diffuser: the caustic changes little, the image grows."""
    z_um = world().scene.optics.diffuser_to_sensor_um + by_um
    optics = world().scene.optics.model_copy(update={"diffuser_to_sensor_um": z_um})
    spec = world().spec.model_copy(update={"optics": optics})
    return frame_of_retina(World(spec, VirtualClock()).retina.reflectance["green"], caustic_of_eye(z_um=z_um))


def frame_of_shifted_sensor(by_deg: float) -> Counts:
    """Return a frame of a sensor that is shifted to the right by `by_deg`; equivalent to a shifted lamp."""
    return np.roll(frame_through(caustic_of_eye()), round(by_deg * world().geometry.px_per_deg), 1)
