"""Fault injection into a simulated calibration bench by name, for tests and training."""

from collections.abc import Callable

import numpy as np

from device.errors import SettingError
from device.sim import calibration_targets
from device.sim.world import World
from device.values import Illumination


def inject_fault(world: World, name: str) -> None:
    """Inject one of `BENCH_FAULTS` into the present target, lamp or camera; SettingError for an unknown name."""
    if name not in BENCH_FAULTS:
        raise SettingError(f"no mishap is called {name!r}", f"Choose from {', '.join(sorted(BENCH_FAULTS))}.")
    BENCH_FAULTS[name](world)


def clear_faults(world: World) -> None:
    """Turn the lamp off and end the faults "moving" and "other mode"; a target changed by a fault stays changed."""
    world.illumination = None
    world.shake_px = 0
    world.faults.discard("camera.mode")


def _scaled_light(factor: float) -> Callable[[World], None]:
    """Return a fault function that multiplies the target's light by a factor."""

    def change(world: World) -> None:
        assert world.target is not None
        world.target = world.target * np.float32(factor)

    return change


def _moving_target(world: World) -> None:
    """Shift the target by one column in every second frame."""
    world.shake_px = 1


def _lamp_on(world: World) -> None:
    """Set the World's lamp to full drive in the picture's colour."""
    world.illumination = Illumination(world.spec.light.colour)


def _cap_on(world: World) -> None:
    """Replace the target by the closed cap: no light."""
    world.target = calibration_targets.cap(world)


def _cap_off(world: World) -> None:
    """Replace the target by a bright screen, which fills the full well in one exposure."""
    world.target = calibration_targets.screen(world, world.spec.camera.full_well_e / world.spec.camera.exposure_s)


def _finger(world: World) -> None:
    """Attenuate a vertical strip of the target to 0.67, as a finger in the light path would."""
    assert world.target is not None
    rows, cols = world.shape
    shaded = world.target.copy()
    shaded[rows // 3 :, cols // 2 : cols // 2 + cols // 8] *= np.float32(0.67)
    world.target = shaded


def _other_mode(world: World) -> None:
    """Switch the camera to another sensor mode, which reads every other row and column."""
    world.faults.add("camera.mode")


BENCH_FAULTS: dict[str, Callable[[World], None]] = {
    "too bright": _scaled_light(1e5),
    "too dark": _scaled_light(5e-4),
    "moving": _moving_target,
    "lamp on": _lamp_on,
    "cap on": _cap_on,
    "cap off": _cap_off,
    "finger": _finger,
    "other mode": _other_mode,
}
