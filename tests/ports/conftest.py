"""The parts under contract. A new camera or lamp joins by one line in IMPLEMENTATIONS."""

import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from device.clock import Clock, SystemClock, VirtualClock
from device.drivers.guardian import Guardian
from device.drivers.pi_camera import PiCamera
from device.drivers.ring import Apa102Ring
from device.drivers.v4l2_camera import V4l2Camera
from device.guard import GuardedLight
from device.head import hazard_of
from device.ledger import MemoryLedger
from device.ports import Camera, Light
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.replay import ReplayCamera, ReplayLight
from device.sim.world import World
from device.spec import ChainSpec, InstrumentSpec, ReplaySpec, load_head
from tests.ports.emulators.timeline import Timeline
from tests.ports.emulators.video import EmulatedVideo

sys.path.insert(0, str(Path(__file__).parent / "emulators" / "pi"))  # what only Raspberry Pi OS has

HEAD = Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml"


def pytest_report_header() -> str:
    """Which real packages the drivers are exercised through."""
    found = ", ".join(f"{name} {version(name)}" for name in ("picamera2", "spidev", "smbus2"))
    return f"drivers through: {found}; Python {platform.python_version()}"


@dataclass
class Rig:
    """A camera and the lamp that lights what it sees."""

    camera: Camera
    light: Light
    clock: Clock
    recorded: bool = False  # what it shows was exposed long ago: colour and duration change nothing

    def close(self) -> None:
        """Dark, and gone."""
        self.light.off()
        self.camera.close()
        if isinstance(self.light, Apa102Ring):
            self.light.close()


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
    return Rig(
        rig.camera, GuardedLight(rig.light, rig.clock, 30, hazard_of(small_head()), MemoryLedger(rig.clock)), rig.clock
    )


def replay_rig(shape: tuple[int, ...] = (24, 32)) -> Rig:
    """Two recorded frames, 12 bits, with their black level."""
    clock, lamp, rng = VirtualClock(), ReplayLight(), np.random.default_rng(0)
    with TemporaryDirectory() as folder:
        raws = tuple(Path(folder) / f"raw{n}.npy" for n in range(2))
        for path in raws:
            np.save(path, rng.integers(64, 4096, shape).astype(np.uint16))
        camera = ReplayCamera(ReplaySpec(raws=raws, psfs=raws, black_dn=64), lamp, clock)
    return Rig(camera, lamp, clock, recorded=True)


def pi_rig(*, wide: bool = False) -> Rig:
    """The real picamera2 over an emulated libcamera, whose sensor looks at a simulated world in real time."""
    timeline = Timeline()
    light = SimLight(timeline)
    return Rig(emulated_camera(timeline, light, wide=wide), light, SystemClock())


def ring_rig() -> Rig:
    """That camera, lit by the real spidev's bytes: the LEDs that shine are decoded from the emulated wire."""
    from tests.ports.emulators.wires import wires

    chain = ChainSpec()
    wires().break_()
    light = Apa102Ring(chain, Guardian(chain.device, chain.rows * chain.cols), lease_s=30)
    return Rig(emulated_camera(wires(), light), light, SystemClock())


def emulated_camera(lamp: Callable, light: Light, *, wide: bool = False) -> PiCamera:
    """picamera2's camera on a sensor of its own, which sees what `lamp` says."""
    import libcamera

    from tests.ports.emulators.memory import MemoryAllocator
    from tests.ports.emulators.sensor import Sensor

    clock = SystemClock()
    libcamera.plugged.append(Sensor(World(small_head(), clock), lamp, wide=wide))
    spec = small_head().camera.model_copy(update={"backend": "picamera2", "sensor": "imx296", "exposure_s": 0.02})
    return PiCamera(spec, light, allocator=MemoryAllocator(), simulated=True)


def v4l2_rig(grants: str, bits: int) -> Rig:
    """The V4L2 driver over an emulated device of one format, in real time."""
    head = small_head()
    black_dn = 60.0 * 2 ** (bits - 10)
    camera = head.camera.model_copy(update={"backend": "v4l2", "bit_depth": bits, "black_dn": black_dn})
    world = World(head.model_copy(update={"camera": camera}), SystemClock())
    light = SimLight(world)
    driver = V4l2Camera(camera, light, world.clock, simulated=True, transport=EmulatedVideo(world, grants))
    return Rig(driver, light, world.clock)


IMPLEMENTATIONS: dict[str, Callable[[], Rig]] = {
    "sim": sim_rig,
    "sim, guarded": guarded_rig,
    "replay": replay_rig,
    "picamera2 as on a Pi 4": pi_rig,
    "picamera2 as on a Pi 5": partial(pi_rig, wide=True),
    "picamera2, spidev": ring_rig,
    "v4l2, GREY": partial(v4l2_rig, "GREY", 8),
    "v4l2, Y10": partial(v4l2_rig, "Y10 ", 10),
    "v4l2, Y12": partial(v4l2_rig, "Y12 ", 12),
    "v4l2, Y16": partial(v4l2_rig, "Y16 ", 12),
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
