"""`diffuscope doctor --parts` on emulated parts: each present part is listed, each missing part has a remedy."""

import libcamera
import pytest

from device.clock import SystemClock
from device.head import probe
from device.sim.world import World
from tests.ports.conftest import small_head
from tests.ports.emulators.memory import MemoryAllocator
from tests.ports.emulators.sensor import Sensor
from tests.ports.emulators.wires import emulated_buses
from tests.ports.test_press import head_with_real_drivers

LEDS = (19, 20, 26, 29, 34, 37, 43, 44)


@pytest.fixture
def sensor():
    before = list(libcamera.plugged)
    emulated_buses().set_faults()
    libcamera.plugged.append(Sensor(World(small_head(), SystemClock()), emulated_buses()))
    yield libcamera.plugged[-1]
    emulated_buses().set_faults()
    libcamera.plugged[:] = before


def found() -> dict[str, tuple[bool, str, str]]:
    spec = head_with_real_drivers()
    quick = spec.camera.model_copy(update={"preview_exposure_s": 0.02})
    spec = spec.model_copy(update={"camera": quick})
    return {
        finding.part: (finding.ok, finding.reading, finding.remedy)
        for finding in probe(spec, SystemClock(), MemoryAllocator())
    }


def test_every_present_part_is_listed(sensor):
    parts = found()
    assert [part for part, (ok, *_) in parts.items() if not ok] == []
    assert "imx296" in parts["camera"][1]
    assert "R12" in parts["camera"][1]
    assert {f"LED {led}" for led in LEDS} <= set(parts)
    assert parts["thermometer"][1] == "25.0 C"
    assert not emulated_buses().lit


def test_a_dead_led_is_found_by_lighting_it(sensor):
    emulated_buses().set_faults("led.26")
    parts = found()
    assert [part for part, (ok, *_) in parts.items() if not ok] == ["LED 26"]
    assert "technician" in parts["LED 26"][2]


def test_a_missing_camera_does_not_hide_other_parts(sensor):
    libcamera.plugged.clear()
    parts = found()
    assert not parts["camera"][0]
    assert parts["camera"][2]
    assert parts["lamp"][0]
    assert parts["thermometer"][0]


def test_a_cut_bus_and_silent_chips_are_each_reported(sensor):
    emulated_buses().set_faults("spi.cut", "i2c.silent")
    parts = found()
    assert {part for part, (ok, *_) in parts.items() if not ok} == {"lamp", "thermometer", "battery", "head's memory"}
    assert parts["camera"][0]
