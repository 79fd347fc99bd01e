"""The full well: what is brighter is lost (optics.md 3.9)."""

from dataclasses import replace

from device.sim.setup import Scene, Setup, Size

name = "saturation"

SIGMAS = 6.0  # of its noise, by which the brightest pixel may stay below the well and never reach it


def size(scene: Scene) -> Size:
    """Nothing while the brightest pixel and its noise stay below the well; else no small change."""
    full_e = scene.spec.camera.full_well_e
    flaws, exposure_s = scene.sim.sensor, scene.spec.camera.exposure_s
    even = scene.peak_e * (1 + scene.sim.light.stray + scene.sim.light.ambient) + flaws.dark_e_per_s * exposure_s
    top_e = even * (1 + SIGMAS * flaws.prnu + abs(flaws.nonlinearity)) + SIGMAS * scene.noise_e
    why = f"the brightest pixel collects up to {top_e:.0f} of {full_e:.0f} electrons"
    return Size(0.0 if top_e < full_e and not flaws.hot_pixels else 10.0 * scene.weight, why)


def apply(setup: Setup) -> None:
    """No pixel holds more than its well."""
    setup.sensor = replace(setup.sensor, full_well_e=setup.scene.spec.camera.full_well_e)
