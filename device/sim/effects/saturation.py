"""The full well, and the converter that ends with it: what is brighter is lost (optics.md 3.9)."""

from dataclasses import replace
from math import sqrt

from device.sim.effects.reflex import brightest
from device.sim.setup import Scene, Setup, Size

name = "saturation"

SIGMAS = 6.0  # of its noise, by which the brightest pixel may stay below the well and never reach it


def size(scene: Scene) -> Size:
    """Nothing while the brightest pixel and its noise stay below the well; else no small change."""
    full_e = scene.spec.camera.full_well_e
    flaws, exposure_s = scene.sim.sensor, scene.spec.camera.exposure_s
    veils = scene.sim.light.stray + scene.sim.light.ambient + brightest(scene)
    even_e = scene.peak_e * (1 + veils) + flaws.dark_e_per_s * exposure_s
    noise_e = sqrt(even_e + scene.spec.camera.read_noise_e**2 + flaws.dsnu_e**2)
    top_e = (even_e * (1 + SIGMAS * flaws.prnu) + SIGMAS * noise_e) * (1 + max(flaws.nonlinearity, 0))
    why = f"the brightest pixel collects up to {top_e:.0f} of {full_e:.0f} electrons"
    return Size(0.0 if top_e < full_e and not flaws.hot_pixels else 10.0 * scene.weight, why)


def apply(setup: Setup) -> None:
    """No pixel holds more than its well, and no count is above the converter's end."""
    camera = setup.scene.spec.camera
    setup.sensor = replace(setup.sensor, full_well_e=camera.full_well_e, white_dn=camera.white_dn)
