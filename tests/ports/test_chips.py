"""Contract of every Thermometer, Battery and HeadMemory, simulated or over an emulated I2C bus (device/ports.py)."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import pytest

from device.clock import VirtualClock
from device.drivers.chips import Eeprom24, I2cBus, Max17048, Tmp117
from device.errors import BusFault, MemoryDamaged
from device.ports import Battery, HeadMemory, Thermometer
from device.sim.chips import SimBattery, SimHeadMemory, SimThermometer
from device.sim.world import World
from device.values import BatteryState, HeadIdentity
from tests.ports.conftest import small_head
from tests.ports.emulators.wires import emulated_buses

READS = 300  # of each chip; a shared address was seen wrong within ten
IDENTITY = HeadIdentity("DS-0042", "9f" * 32)


@dataclass
class Chips:
    """Chips of one head, with a switch that stops their answers."""

    thermometer: Thermometer
    battery: Battery
    memory: HeadMemory
    silence: Callable[[bool], None]
    close: Callable[[], None] = lambda: None


def simulated() -> Chips:
    world = World(small_head(), VirtualClock())

    def silence(on: bool) -> None:
        world.faults = {"bus.silent"} if on else set()

    return Chips(SimThermometer(world), SimBattery(world), SimHeadMemory(world), silence)


def emulated() -> Chips:
    """Return the chips over the real smbus2."""
    emulated_buses().set_faults()
    bus = I2cBus("/dev/i2c-1")

    def silence(on: bool) -> None:
        emulated_buses().set_faults(*["i2c.silent"] * on)

    memory = Eeprom24(bus, 0x50, VirtualClock())
    return Chips(Tmp117(bus, 0x48), Max17048(bus, 0x36), memory, silence, bus.close)


@pytest.fixture(params=[simulated, emulated], ids=["sim", "smbus2"])
def chips(request):
    made = request.param()
    yield made
    made.silence(False)
    made.close()


def test_the_thermometer_returns_degrees_celsius(chips):
    assert chips.thermometer.read_c() == 25.0


def test_the_battery_returns_charge_and_voltage(chips):
    assert chips.battery.read() == BatteryState(pytest.approx(0.775, abs=0.002), pytest.approx(3.88, abs=0.01))


def test_chips_that_two_threads_read_at_once_do_not_answer_for_one_another(chips):
    """The page asks for the health while a press reads the same chips."""
    with ThreadPoolExecutor(2) as threads:
        warm = threads.submit(lambda: {chips.thermometer.read_c() for _ in range(READS)})
        charge = threads.submit(lambda: {round(chips.battery.read().fraction, 3) for _ in range(READS)})
    assert (warm.result(), charge.result()) == ({25.0}, {0.775})


def test_the_memory_stores_the_identity_of_the_head(chips):
    chips.memory.write(IDENTITY)
    assert chips.memory.read() == IDENTITY
    other = HeadIdentity("DS-0043", "0a" * 32)
    chips.memory.write(other)
    assert chips.memory.read() == other


def test_a_silent_bus_raises_bus_fault_with_a_remedy(chips):
    chips.silence(True)
    for ask in (chips.thermometer.read_c, chips.battery.read, chips.memory.read, lambda: chips.memory.write(IDENTITY)):
        with pytest.raises(BusFault) as caught:
            ask()
        assert "technician" in caught.value.remedy


@pytest.mark.parametrize(("place", "message"), [(0, "something else"), (12, "checksum")])
def test_a_damaged_memory_is_distinguished_from_a_blank_one(place, message):
    emulated_buses().set_faults()
    bus = I2cBus("/dev/i2c-1")
    memory = Eeprom24(bus, 0x50, VirtualClock())
    memory.write(IDENTITY)
    bus.write(0x50, place.to_bytes(2, "big") + b"\x00")
    with pytest.raises(MemoryDamaged, match=message) as caught:
        memory.read()
    assert "diffuscope calibrations use" in caught.value.remedy
    bus.close()


class PowerCutClock(VirtualClock):
    """Clock that simulates a power cut while the memory stores its n-th page."""

    def __init__(self, pages: int) -> None:
        super().__init__()
        self.pages = pages

    def sleep(self, duration_s: float) -> None:
        self.pages -= 1
        if not self.pages:
            raise KeyboardInterrupt
        super().sleep(duration_s)


@pytest.mark.parametrize("pages", [1, 2, 3])
def test_a_power_cut_during_a_write_is_detected_and_repaired_by_a_new_write(pages):
    emulated_buses().set_faults()
    bus = I2cBus("/dev/i2c-1")
    memory = Eeprom24(bus, 0x50, VirtualClock())
    memory.write(IDENTITY)
    other = HeadIdentity("DS-0007-rebuilt", "0a" * 32)
    with pytest.raises(KeyboardInterrupt):
        Eeprom24(bus, 0x50, PowerCutClock(pages)).write(other)
    with pytest.raises(MemoryDamaged):
        memory.read()
    memory.write(other)
    assert memory.read() == other
    bus.close()


def test_a_missing_bus_raises_bus_fault():
    with pytest.raises(BusFault, match="i2c-7"):
        I2cBus("/dev/i2c-7")
