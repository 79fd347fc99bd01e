"""Fixtures of the port contract tests; a new camera or lamp joins by one line in IMPLEMENTATIONS."""

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
from device.config.head_file import ChainSpec, InstrumentSpec, ReplaySpec, load_head
from device.drivers.guardian import Guardian
from device.drivers.pi_camera import PiCamera
from device.drivers.ring import Apa102Ring, LedRing, Tlc5971Ring
from device.drivers.v4l2_camera import V4l2Camera
from device.head import hazard_of
from device.light_safety.dose_ledger import MemoryLedger
from device.light_safety.guard import GuardedLight
from device.ports import Camera, Light
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.replay import ReplayCamera, ReplayLight
from device.sim.world import World
from tests.ports.emulators.timeline import Timeline
from tests.ports.emulators.video import EmulatedVideo

sys.path.insert(
    0, str(Path(__file__).parent / "emulators" / "pi")
)  # emulated modules that exist only on Raspberry Pi OS

HEAD = Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml"


def pytest_report_header() -> str:
    """Return the versions of the hardware libraries that the drivers run on."""
    found = ", ".join(f"{name} {version(name)}" for name in ("picamera2", "spidev", "smbus2"))
    return f"drivers through: {found}; Python {platform.python_version()}"


@dataclass
class Rig:
    """Camera with the lamp that lights its scene."""

    camera: Camera
    light: Light
    clock: Clock
    recorded: bool = False  # a recording: colour and duration have no effect

    def close(self) -> None:
        """Turn the lamp off and close all parts."""
        self.light.off()
        self.camera.close()
        if isinstance(self.light, LedRing):
            self.light.close()


@dataclass
class SimRig(Rig):
    """Simulated camera and lamp of one world."""

    camera: SimCamera


def small_head() -> InstrumentSpec:
    """Return the simulated head with sixteen times fewer, larger pixels."""
    spec = load_head(HEAD)
    coarse = {"rows": 270, "cols": 480, "pitch_um": 4 * spec.camera.pitch_um}
    return spec.model_copy(update={"camera": spec.camera.model_copy(update=coarse)})


def sim_rig() -> SimRig:
    world = World(small_head(), VirtualClock())
    return SimRig(SimCamera(world), SimLight(world), world.clock)


def guarded_rig() -> SimRig:
    rig = sim_rig()
    return SimRig(
        rig.camera, GuardedLight(rig.light, rig.clock, 30, hazard_of(small_head()), MemoryLedger(rig.clock)), rig.clock
    )


def replay_rig(shape: tuple[int, ...] = (24, 32)) -> Rig:
    """Return a rig of two recorded 12-bit frames with their black level."""
    clock, lamp, rng = VirtualClock(), ReplayLight(), np.random.default_rng(0)
    with TemporaryDirectory() as folder:
        raws = tuple(Path(folder) / f"raw{n}.npy" for n in range(2))
        for path in raws:
            np.save(path, rng.integers(64, 4096, shape).astype(np.uint16))
        camera = ReplayCamera(ReplaySpec(raws=raws, psfs=raws, black_dn=64), lamp, clock)
    return Rig(camera, lamp, clock, recorded=True)


def pi_rig(*, wide: bool = False) -> Rig:
    """Return the real picamera2 over an emulated libcamera, whose sensor exposes a simulated world in real time."""
    timeline = Timeline()
    light = SimLight(timeline)
    return Rig(emulated_camera(timeline, light, wide=wide), light, SystemClock())


def ring_rig() -> Rig:
    """Return picamera2's camera, lit by the real spidev: the lit LEDs are decoded from the emulated SPI bus."""
    from tests.ports.emulators.wires import emulated_buses

    chain = ChainSpec()
    emulated_buses().set_faults()
    light = Apa102Ring(chain, Guardian(chain.device, chain.rows * chain.cols), lease_s=30)
    return Rig(emulated_camera(emulated_buses(), light), light, SystemClock())


def sink_rig() -> Rig:
    """Return picamera2's camera, lit by TLC5971 drivers over the real spidev on the second emulated bus."""
    from tests.ports.emulators.wires import SINKS, emulated_buses

    emulated_buses().set_faults()
    light = Tlc5971Ring(SINKS, Guardian(SINKS.device, chip="tlc5971"), lease_s=30)
    return Rig(emulated_camera(emulated_buses().sinks, light), light, SystemClock())


def emulated_camera(lamp: Callable, light: Light, *, wide: bool = False) -> PiCamera:
    """Return picamera2's camera on a new emulated sensor, which is lit as `lamp` reports."""
    import libcamera

    from tests.ports.emulators.memory import MemoryAllocator
    from tests.ports.emulators.sensor import Sensor

    clock = SystemClock()
    libcamera.plugged.append(Sensor(World(small_head(), clock), lamp, wide=wide))
    spec = small_head().camera.model_copy(update={"backend": "picamera2", "sensor": "imx296", "exposure_s": 0.02})
    return PiCamera(spec, light, allocator=MemoryAllocator(), simulated=True)


def v4l2_rig(grants: str, bits: int) -> Rig:
    """Return the V4L2 driver over an emulated device of one format, in real time."""
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
    "picamera2, spidev, TLC5971": sink_rig,
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
    """Yield a rig whose lamp is off before and after every test."""
    rig_of_module.light.off()
    yield rig_of_module
    rig_of_module.light.off()


@pytest.fixture
def live_rig(rig):
    """Yield a rig that exposes the present scene, not a recording."""
    if rig.recorded:
        pytest.skip("a recording was exposed once, in one light")
    return rig


@pytest.fixture(params=sorted(IMPLEMENTATIONS))
def fresh_rig(request):
    """Yield a new rig, which a test may break or close."""
    rig = IMPLEMENTATIONS[request.param]()
    yield rig
    rig.close()
