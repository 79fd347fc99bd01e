"""Faults of a camera on a Raspberry Pi: each has its name and its remedy, through the real picamera2."""

import gc

import libcamera
import pytest

from device.clock import SystemClock
from device.drivers.pi_camera import PiCamera
from device.errors import CameraMissing, CameraPacked, CameraStalled, CameraWrong, HardwareError
from device.sim.light import SimLight
from device.sim.world import World
from device.values import Glow, Shot
from tests.ports.conftest import small_head
from tests.ports.emulators.memory import MemoryAllocator
from tests.ports.emulators.sensor import Sensor
from tests.ports.emulators.timeline import Timeline

SHOT = Shot(0.02)


class Bench:
    """A sensor that may be broken, and cameras opened on it."""

    def __init__(self) -> None:
        self.timeline, self.clock, self.cameras = Timeline(), SystemClock(), []
        self.sensor = Sensor(World(small_head(), self.clock), self.timeline)
        libcamera.plugged.append(self.sensor)

    def open(self, patience_s: float = 2.0, **said: object) -> PiCamera:
        changed = {"backend": "picamera2", "sensor": "imx296", "exposure_s": SHOT.exposure_s} | said
        spec = small_head().camera.model_copy(update=changed)
        light, memory = SimLight(self.timeline), MemoryAllocator()
        camera = PiCamera(spec, light, allocator=memory, patience_s=patience_s, simulated=True)
        self.cameras.append(camera)
        return camera


@pytest.fixture
def bench():
    before = list(libcamera.plugged)
    made = Bench()
    yield made
    for camera in made.cameras:
        camera.close()
    libcamera.plugged[:] = before


def test_no_camera_is_missing_and_not_replaced(bench):
    libcamera.plugged.clear()
    with pytest.raises(CameraMissing) as told:
        bench.open()
    assert "turn the device off and on" in told.value.remedy


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # picamera2 leaves a pipe open there
def test_a_camera_that_someone_else_holds_is_missing(bench):
    bench.sensor.held = True
    with pytest.raises(CameraMissing):
        bench.open()
    bench.sensor.held = False
    gc.collect()


@pytest.mark.parametrize("fault", ["packed", "compressed"])
def test_counts_that_are_packed_or_compressed_are_refused(bench, fault):
    bench.sensor.faults = {fault}
    with pytest.raises(CameraPacked) as told:
        bench.open()
    assert "Update the operating system" in told.value.remedy


@pytest.mark.parametrize("said", [{"sensor": "imx477"}, {"rows": 300}, {"black_dn": 600.0}])
def test_another_sensor_mode_or_black_level_is_the_wrong_camera(bench, said):
    with pytest.raises(CameraWrong):
        bench.open(**said)


def test_a_pi_5_that_does_not_lift_its_counts_is_found_out(bench):
    bench.sensor.wide, bench.sensor.faults = True, {"justified"}
    with pytest.raises(CameraWrong, match="lowest 4 bits"):
        bench.open()


def test_a_control_that_never_lands_is_an_error_and_no_picture(bench):
    camera = bench.open()
    bench.sensor.faults = {"stale"}
    with pytest.raises(CameraStalled, match="none was exposed"):
        camera.expose(Shot(0.005))


def test_the_frame_has_the_exposure_that_was_asked_and_the_light_of_its_time(bench):
    camera, light = bench.open(), SimLight(bench.timeline)
    means = {}
    for exposure_s in (0.01, 0.02, 0.01):
        with light.on(Glow("green")):
            frame = camera.expose(Shot(exposure_s))
        means[exposure_s] = frame.counts.mean() - 64
        assert frame.glow == Glow("green")
    assert means[0.02] / means[0.01] == pytest.approx(2, rel=0.05)
    assert camera.expose(SHOT).counts.mean() - 64 < 0.02 * means[0.02]


def test_a_lamp_that_is_cut_during_the_exposure_is_told(bench):
    from threading import Timer

    camera, light = bench.open(), SimLight(bench.timeline)
    cut = Timer(0.1, light.off)
    cut.start()
    with light.on(Glow("green")):
        assert camera.expose(Shot(0.3)).glow is None
    cut.join()


def test_a_camera_that_stalls_is_opened_anew_once_and_then_given_up(bench):
    camera = bench.open(patience_s=0.2)
    bench.sensor.faults = {"stall"}
    with pytest.raises(CameraStalled) as told:
        camera.expose(SHOT)
    assert isinstance(told.value, HardwareError)
    bench.sensor.faults = set()


def test_no_padding_reaches_a_picture(bench):
    assert bench.open().expose(SHOT).counts.max() < 0xA5A5 >> 4
