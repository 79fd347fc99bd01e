"""What goes wrong on a bench while a simulated head is calibrated, by name: for tests, and for people who practise."""

from collections.abc import Callable

import numpy as np

from device.errors import SettingError
from device.sim import stage
from device.sim.world import World
from device.values import Glow


def spoil(world: World, name: str) -> None:
    """Let that mishap happen to what stands before the head now; SettingError for one that does not exist."""
    if name not in MISHAPS:
        raise SettingError(f"no mishap is called {name!r}", f"Choose from {', '.join(sorted(MISHAPS))}.")
    MISHAPS[name](world)


def mend(world: World) -> None:
    """Everything is well again, but for what stands there."""
    world.glow, world.shake_px = None, 0
    world.faults.discard("camera.mode")


def _brighter(factor: float) -> Callable[[World], None]:
    def change(world: World) -> None:
        assert world.stage is not None
        world.stage = world.stage * np.float32(factor)

    return change


def _moving(world: World) -> None:
    world.shake_px = 1


def _lamp(world: World) -> None:
    world.glow = Glow(world.spec.light.colour)


def _capped(world: World) -> None:
    world.stage = stage.cap(world)


def _uncapped(world: World) -> None:
    world.stage = stage.screen(world, world.spec.camera.full_well_e / world.spec.camera.exposure_s)


def _finger(world: World) -> None:
    """It takes a third of the light from a strip."""
    assert world.stage is not None
    rows, cols = world.shape
    shaded = world.stage.copy()
    shaded[rows // 3 :, cols // 2 : cols // 2 + cols // 8] *= np.float32(0.67)
    world.stage = shaded


def _other_mode(world: World) -> None:
    world.faults.add("camera.mode")


MISHAPS: dict[str, Callable[[World], None]] = {
    "too bright": _brighter(1e5),
    "too dark": _brighter(5e-4),
    "moving": _moving,
    "lamp on": _lamp,
    "cap on": _capped,
    "cap off": _uncapped,
    "finger": _finger,
    "other mode": _other_mode,
}
