"""Camera faults on a Raspberry Pi, through the real picamera2: each has its error and its remedy."""

import gc

import libcamera
import pytest

from device.clock import SystemClock
from device.drivers.pi_camera import PiCamera
from device.errors import CameraMismatch, CameraMissing, CameraPacked, CameraStalled, HardwareError
from device.sim.light import SimLight
from device.sim.world import World
from device.values import ExposureSettings, Illumination
from tests.ports.conftest import small_head
from tests.ports.emulators.memory import MemoryAllocator
from tests.ports.emulators.sensor import Sensor
from tests.ports.emulators.timeline import Timeline
from tests.raspberry_pi import IMX708_LOWEST_GAIN

SHOT = ExposureSettings(0.02)
PATIENCE_S = 2.0  # the first frame of a camera took more than 0.2 s on a busy machine


class Bench:
    """Emulated sensor with faults, and the cameras opened on it."""

    def __init__(self) -> None:
        self.timeline, self.clock, self.cameras = Timeline(), SystemClock(), []
        self.sensor = Sensor(World(small_head(), self.clock), self.timeline)
        libcamera.plugged.append(self.sensor)

    def open(self, **changes: object) -> PiCamera:
        update = {"backend": "picamera2", "sensor": "imx296", "exposure_s": SHOT.exposure_s} | changes
        spec = small_head().camera.model_copy(update=update)
        light, memory = SimLight(self.timeline), MemoryAllocator()
        camera = PiCamera(spec, light, allocator=memory, patience_s=PATIENCE_S, simulated=True)
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


def test_without_a_camera_camera_missing_is_raised_and_none_is_substituted(bench):
    libcamera.plugged.clear()
    with pytest.raises(CameraMissing) as caught:
        bench.open()
    assert "turn the device off and on" in caught.value.remedy


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # picamera2 leaves a pipe open there
def test_a_camera_held_by_another_process_raises_camera_missing(bench):
    bench.sensor.held = True
    with pytest.raises(CameraMissing):
        bench.open()
    bench.sensor.held = False
    gc.collect()


@pytest.mark.parametrize("fault", ["packed", "compressed"])
def test_packed_or_compressed_counts_are_refused(bench, fault):
    bench.sensor.faults = {fault}
    with pytest.raises(CameraPacked) as caught:
        bench.open()
    assert "Update the operating system" in caught.value.remedy


@pytest.mark.parametrize("changes", [{"sensor": "imx477"}, {"rows": 300}, {"black_dn": 600.0}])
def test_another_sensor_mode_or_black_level_raises_camera_wrong(bench, changes):
    with pytest.raises(CameraMismatch):
        bench.open(**changes)


def test_right_justified_counts_on_a_pi_5_are_detected(bench):
    bench.sensor.wide, bench.sensor.faults = True, {"justified"}
    with pytest.raises(CameraMismatch, match="lowest 4 bits"):
        bench.open()


def test_a_control_without_effect_raises_camera_stalled(bench):
    camera = bench.open()
    bench.sensor.faults = {"stale"}
    with pytest.raises(CameraStalled, match="none was exposed"):
        camera.expose(ExposureSettings(0.005))


def test_a_frame_has_the_requested_exposure_and_the_illumination_of_its_time(bench):
    camera, light = bench.open(), SimLight(bench.timeline)
    means = {}
    for exposure_s in (0.01, 0.02, 0.01):
        with light.on(Illumination("green")):
            frame = camera.expose(ExposureSettings(exposure_s))
        means[exposure_s] = frame.counts.mean() - 64
        assert frame.illumination == Illumination("green")
    assert means[0.02] / means[0.01] == pytest.approx(2, rel=0.05)
    assert camera.expose(SHOT).counts.mean() - 64 < 0.02 * means[0.02]


def test_a_lamp_cut_during_the_exposure_is_reported_as_no_illumination(bench):
    from threading import Timer

    camera, light = bench.open(), SimLight(bench.timeline)
    cut = Timer(0.1, light.off)
    cut.start()
    with light.on(Illumination("green")):
        assert camera.expose(ExposureSettings(0.3)).illumination is None
    cut.join()


def test_a_stalled_camera_is_reopened_once_and_then_raises_camera_stalled(bench):
    camera = bench.open()
    bench.sensor.faults = {"stall"}
    with pytest.raises(CameraStalled) as caught:
        camera.expose(SHOT)
    assert isinstance(caught.value, HardwareError)
    bench.sensor.faults = set()


def test_row_padding_does_not_reach_the_counts(bench):
    assert bench.open().expose(SHOT).counts.max() < 0xA5A5 >> 4


def test_a_sensor_whose_lowest_gain_is_above_one_gives_frames(bench):
    """Defect 13: an IMX708 begins at 1.123, which was never the gain that was asked for."""
    bench.sensor.lowest_gain = IMX708_LOWEST_GAIN
    assert bench.open().expose(SHOT).counts.mean() > 0


def test_a_colour_sensor_where_a_monochrome_one_is_expected_is_refused(bench):
    bench.sensor.arrangement = 0
    with pytest.raises(CameraMismatch, match=r"has colour filters \(RGGB\)") as caught:
        bench.open()
    assert "bayer = true" in caught.value.remedy


def test_colour_filters_of_an_unknown_arrangement_are_refused(bench):
    bench.sensor.arrangement = 4  # libcamera: RGB, three values per pixel
    with pytest.raises(CameraMismatch, match=r"unknown arrangement"):
        bench.open()


def test_an_expected_mosaic_is_read_as_the_sensor_gives_it(bench):
    """The raw counts stay those of the sensor; `reconstruct --bayer` takes them apart."""
    bench.sensor.arrangement = 0
    camera = bench.open(bayer=True)
    assert camera.facts == {"sensor": "imx296", "format": "SRGGB12", "mosaic": "RGGB"}
    assert camera.expose(SHOT).counts.shape == camera.shape
