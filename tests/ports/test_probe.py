"""`diffuscope probe` on emulated parts: what is there is named, what is not is told with its remedy."""

import libcamera
import pytest

from device.clock import SystemClock
from device.probe import probe
from device.sim.world import World
from tests.ports.conftest import small_head
from tests.ports.emulators.memory import MemoryAllocator
from tests.ports.emulators.sensor import Sensor
from tests.ports.emulators.wires import wires
from tests.ports.test_press import real_parts

LEDS = (19, 20, 26, 29, 34, 37, 43, 44)


@pytest.fixture
def sensor():
    before = list(libcamera.plugged)
    wires().break_()
    libcamera.plugged.append(Sensor(World(small_head(), SystemClock()), wires()))
    yield libcamera.plugged[-1]
    wires().break_()
    libcamera.plugged[:] = before


def found() -> dict[str, tuple[bool, str, str]]:
    spec = real_parts()
    quick = spec.camera.model_copy(update={"preview_exposure_s": 0.02})
    spec = spec.model_copy(update={"camera": quick})
    return {one.part: (one.ok, one.said, one.remedy) for one in probe(spec, SystemClock(), MemoryAllocator())}


def test_everything_that_is_there_is_named(sensor):
    said = found()
    assert [part for part, (ok, *_) in said.items() if not ok] == []
    assert "imx296" in said["camera"][1]
    assert "R12" in said["camera"][1]
    assert {f"LED {led}" for led in LEDS} <= set(said)
    assert said["thermometer"][1] == "25.0 C"
    assert not wires().lit


def test_a_dead_led_is_found_by_lighting_it(sensor):
    wires().break_("led.26")
    said = found()
    assert [part for part, (ok, *_) in said.items() if not ok] == ["LED 26"]
    assert "technician" in said["LED 26"][2]


def test_a_missing_camera_hides_nothing_else(sensor):
    libcamera.plugged.clear()
    said = found()
    assert not said["camera"][0]
    assert said["camera"][2]
    assert said["lamp"][0]
    assert said["thermometer"][0]


def test_a_cut_bus_and_silent_chips_are_told_each(sensor):
    wires().break_("spi.cut", "i2c.silent")
    said = found()
    assert {part for part, (ok, *_) in said.items() if not ok} == {"lamp", "thermometer", "battery", "head's memory"}
    assert said["camera"][0]
