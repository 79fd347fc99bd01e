"""The parts under contract. A new camera or lamp joins by one line in IMPLEMENTATIONS."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from device.clock import Clock, VirtualClock
from device.guard import GuardedLight
from device.ports import Camera, Light
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.replay import ReplayCamera, ReplayLight
from device.sim.world import World
from device.spec import InstrumentSpec, ReplaySpec, load_head
from tests.ports.emulators.bus.rig import wired

HEAD = Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml"


@dataclass
class Rig:
    """A camera and the lamp that lights what it sees."""

    camera: Camera
    light: Light
    clock: Clock
    recorded: bool = False  # what it shows was exposed long ago: colour and duration change nothing
    close: Callable[[], None] = lambda: None  # lets go what a test's end would leave open


def small_head() -> InstrumentSpec:
    """The simulated head with sixteen times fewer, larger pixels."""
    spec = load_head(HEAD)
    coarse = {"rows": 270, "cols": 480, "pitch_um": 4 * spec.camera.pitch_um}
    return spec.model_copy(update={"camera": spec.camera.model_copy(update=coarse)})


def sim_rig() -> Rig:
    world = World(small_head(), VirtualClock())
    return Rig(SimCamera(world), SimLight(world), world.clock)


def guarded_rig() -> Rig:
    rig = sim_rig()
    return Rig(rig.camera, GuardedLight(rig.light, rig.clock, max_on_s=30), rig.clock)


def replay_rig(shape: tuple[int, ...] = (24, 32)) -> Rig:
    """Two recorded frames, 12 bits, with their black level."""
    clock, lamp, rng = VirtualClock(), ReplayLight(), np.random.default_rng(0)
    with TemporaryDirectory() as folder:
        raws = tuple(Path(folder) / f"raw{n}.npy" for n in range(2))
        for path in raws:
            np.save(path, rng.integers(64, 4096, shape).astype(np.uint16))
        camera = ReplayCamera(ReplaySpec(raws=raws, psfs=raws, black_dn=64), lamp, clock)
    return Rig(camera, lamp, clock, recorded=True)


def ring_rig() -> Rig:
    """The real ring driver over the emulated bus, seen by the simulated camera."""
    camera, ring, clock = wired(small_head())
    return Rig(camera, ring, clock, close=ring.close)


IMPLEMENTATIONS: dict[str, Callable[[], Rig]] = {
    "sim": sim_rig,
    "sim, guarded": guarded_rig,
    "replay": replay_rig,
    "apa102": ring_rig,
    # drivers over a fake bus join here (over real parts: tests/rig)
}


@pytest.fixture(params=sorted(IMPLEMENTATIONS), scope="module")
def rig_of_module(request):
    rig = IMPLEMENTATIONS[request.param]()
    yield rig
    rig.close()


@pytest.fixture
def rig(rig_of_module):
    """A rig whose lamp is dark before and after every test."""
    rig_of_module.light.off()
    yield rig_of_module
    rig_of_module.light.off()


@pytest.fixture
def live_rig(rig):
    """A rig that exposes what is there now, not what was recorded."""
    if rig.recorded:
        pytest.skip("a recording was exposed once, in one light")
    return rig


@pytest.fixture(params=sorted(IMPLEMENTATIONS))
def fresh_rig(request):
    """A rig of one's own, to be broken or closed."""
    rig = IMPLEMENTATIONS[request.param]()
    yield rig
    rig.close()
