"""The parts under contract. A new camera or lamp joins by one line in IMPLEMENTATIONS."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from device.clock import Clock, VirtualClock
from device.ports import Camera, Light
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.world import World
from device.spec import InstrumentSpec, load_head

HEAD = Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml"


@dataclass
class Rig:
    """A camera and the lamp that lights what it sees."""

    camera: Camera
    light: Light
    clock: Clock


def small_head() -> InstrumentSpec:
    """The simulated head with sixteen times fewer, larger pixels."""
    spec = load_head(HEAD)
    coarse = {"rows": 270, "cols": 480, "pitch_um": 4 * spec.camera.pitch_um}
    return spec.model_copy(update={"camera": spec.camera.model_copy(update=coarse)})


def sim_rig() -> Rig:
    world = World(small_head(), VirtualClock())
    return Rig(SimCamera(world), SimLight(world), world.clock)


IMPLEMENTATIONS: dict[str, Callable[[], Rig]] = {
    "sim": sim_rig,
    # replay joins here; so do drivers over a fake bus (over real parts: tests/rig)
}


@pytest.fixture(params=sorted(IMPLEMENTATIONS), scope="module")
def rig_of_module(request):
    return IMPLEMENTATIONS[request.param]()


@pytest.fixture
def rig(rig_of_module):
    """A rig whose lamp is dark before and after every test."""
    rig_of_module.light.off()
    yield rig_of_module
    rig_of_module.light.off()


@pytest.fixture(params=sorted(IMPLEMENTATIONS))
def fresh_rig(request):
    """A rig of one's own, to be broken or closed."""
    return IMPLEMENTATIONS[request.param]()
