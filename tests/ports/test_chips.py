"""What every Thermometer, Battery and HeadMemory keeps, simulated or real over an emulated bus (device/ports.py)."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest

from device.clock import VirtualClock
from device.drivers.chips import Eeprom24, I2cBus, Max17048, Tmp117
from device.errors import BusFault, MemoryDamaged
from device.ports import Battery, HeadMemory, Thermometer
from device.sim.chips import SimBattery, SimHeadMemory, SimThermometer
from device.sim.world import World
from device.values import Charge, Identity
from tests.ports.conftest import small_head
from tests.ports.emulators.wires import wires

IDENTITY = Identity("DS-0042", "9f" * 32)


@dataclass
class Chips:
    """The chips of one head, and how to silence them."""

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
    """The real smbus2."""
    wires().break_()
    bus = I2cBus("/dev/i2c-1")

    def silence(on: bool) -> None:
        wires().break_(*["i2c.silent"] * on)

    memory = Eeprom24(bus, 0x50, VirtualClock())
    return Chips(Tmp117(bus, 0x48), Max17048(bus, 0x36), memory, silence, bus.close)


@pytest.fixture(params=[simulated, emulated], ids=["sim", "smbus2"])
def chips(request):
    made = request.param()
    yield made
    made.silence(False)
    made.close()


def test_the_thermometer_says_degrees(chips):
    assert chips.thermometer.read_c() == 25.0


def test_the_battery_says_how_full_it_is(chips):
    assert chips.battery.read() == Charge(pytest.approx(0.775, abs=0.002), pytest.approx(3.88, abs=0.01))


def test_the_memory_keeps_who_the_head_is(chips):
    chips.memory.write(IDENTITY)
    assert chips.memory.read() == IDENTITY
    other = Identity("DS-0043", "0a" * 32)
    chips.memory.write(other)
    assert chips.memory.read() == other


def test_a_silent_bus_is_a_fault_with_a_remedy(chips):
    chips.silence(True)
    for ask in (chips.thermometer.read_c, chips.battery.read, chips.memory.read, lambda: chips.memory.write(IDENTITY)):
        with pytest.raises(BusFault) as told:
            ask()
        assert "technician" in told.value.remedy


@pytest.mark.parametrize(("place", "message"), [(0, "something else"), (12, "checksum")])
def test_a_damaged_memory_is_told_from_an_empty_one(place, message):
    wires().break_()
    bus = I2cBus("/dev/i2c-1")
    memory = Eeprom24(bus, 0x50, VirtualClock())
    memory.write(IDENTITY)
    bus.send(0x50, place.to_bytes(2, "big") + b"\x00")
    with pytest.raises(MemoryDamaged, match=message) as told:
        memory.read()
    assert "diffuscope calibrations use" in told.value.remedy
    bus.close()


class ShortOfPower(VirtualClock):
    """Power goes away while the memory keeps its n-th page."""

    def __init__(self, pages: int) -> None:
        super().__init__()
        self.pages = pages

    def sleep(self, duration_s: float) -> None:
        self.pages -= 1
        if not self.pages:
            raise KeyboardInterrupt
        super().sleep(duration_s)


@pytest.mark.parametrize("pages", [1, 2, 3])
def test_a_power_cut_while_it_is_written_is_noticed_and_writing_again_mends_it(pages):
    wires().break_()
    bus = I2cBus("/dev/i2c-1")
    memory = Eeprom24(bus, 0x50, VirtualClock())
    memory.write(IDENTITY)
    other = Identity("DS-0007-rebuilt", "0a" * 32)
    with pytest.raises(KeyboardInterrupt):
        Eeprom24(bus, 0x50, ShortOfPower(pages)).write(other)
    with pytest.raises(MemoryDamaged):
        memory.read()
    memory.write(other)
    assert memory.read() == other
    bus.close()


def test_a_bus_that_is_not_there_is_a_fault():
    with pytest.raises(BusFault, match="i2c-7"):
        I2cBus("/dev/i2c-7")
