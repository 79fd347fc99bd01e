"""Fault handling of the V4L2 driver."""

import pytest

from device.clock import SystemClock
from device.drivers.v4l2_camera import V4l2Camera
from device.errors import CameraMismatch, CameraMissing, CameraPacked, CameraStalled
from device.sim.light import SimLight
from device.sim.world import World
from device.values import ExposureSettings
from tests.ports.conftest import small_head
from tests.ports.emulators.video import EmulatedVideo

PATIENCE_S = 1.0  # a first frame may take a fraction of a second on a busy machine


def head_of_ten_bits():
    spec = small_head()
    camera = {"backend": "v4l2", "bit_depth": 10, "black_dn": 60.0, "exposure_s": 0.1}
    return spec.model_copy(update={"camera": spec.camera.model_copy(update=camera)})


def camera_over(video):
    world = video.world
    light, clock = SimLight(world), SystemClock()
    return V4l2Camera(world.spec.camera, light, clock, simulated=True, patience_s=PATIENCE_S, transport=video)


@pytest.fixture
def world():
    return World(head_of_ten_bits(), SystemClock())


@pytest.mark.parametrize("grants", ["MJPG", "YUYV"])
def test_a_camera_without_unpacked_counts_is_refused_with_its_format(world, grants):
    with pytest.raises(CameraPacked, match=grants) as refused:
        camera_over(EmulatedVideo(world, grants))
    assert "GREY, Y10, Y12, Y16" in refused.value.remedy


def test_a_camera_of_another_bit_depth_raises_camera_wrong(world):
    with pytest.raises(CameraMismatch, match="10 bits"):
        camera_over(EmulatedVideo(world, "Y12 "))


def test_an_absent_camera_raises_camera_missing(world):
    world.faults.add("camera.missing")
    with pytest.raises(CameraMissing, match="No such file") as missing:
        camera_over(EmulatedVideo(world, "Y10 "))
    assert "Plug the camera in" in missing.value.remedy


def test_the_first_frame_of_a_camera_may_take_five_times_as_long(world):
    """While the camera is opened for the first time, the computer starts, too; a frame in the light has to come."""
    video, timeouts = EmulatedVideo(world, "Y10 "), list[float]()
    wait = video.wait
    video.wait = lambda handle, timeout_s: timeouts.append(timeout_s) or wait(handle, timeout_s)
    camera = camera_over(video)
    assert set(timeouts) == {0.1 + 5 * PATIENCE_S}
    timeouts.clear()
    camera.expose(ExposureSettings(0.1))
    assert set(timeouts) == {0.1 + PATIENCE_S}
    camera.close()


def test_an_unplugged_camera_raises_camera_missing(world):
    camera = camera_over(EmulatedVideo(world, "Y10 "))
    world.faults.add("camera.missing")
    with pytest.raises(CameraMissing, match="has gone"):
        camera.expose(ExposureSettings(0.01))
    camera.close()


@pytest.mark.parametrize(("lack", "says"), [("streams", "does not stream"), ("stamped", "old ones would pass")])
def test_a_device_without_streaming_or_timestamps_raises_camera_wrong(world, lack, says):
    video = EmulatedVideo(world, "Y10 ")
    setattr(video, lack, False)
    with pytest.raises(CameraMismatch, match=says):
        camera_over(video)


def test_a_device_without_exposure_control_raises_camera_wrong(world):
    video = EmulatedVideo(world, "Y10 ")
    video.controls.clear()
    with pytest.raises(CameraMismatch, match="exposure time"):
        camera_over(video)


def test_a_silent_camera_is_reopened_once_and_then_raises_camera_stalled(world):
    video = EmulatedVideo(world, "Y10 ")
    camera = camera_over(video)
    video.silent = True
    assert camera.expose(ExposureSettings(0.01)).number == 1
    world.faults.add("camera.stalled")
    with pytest.raises(CameraStalled, match="no frames") as stalled:
        camera.expose(ExposureSettings(0.01))
    assert "cable" in stalled.value.remedy
    camera.close()
