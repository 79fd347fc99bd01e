"""Simulated thermometer, battery gauge, head memory and button of a head, which read the state of a `World`."""

from device.errors import BusFault
from device.sim.world import World
from device.values import BatteryState, HeadIdentity


class SimThermometer:
    """Simulated thermometer: port `Thermometer` on the state of a `World`."""

    def __init__(self, world: World) -> None:
        self._world = world

    def read_c(self) -> float:
        """Return the temperature, degrees Celsius; BusFault while the fault "bus.silent" is active."""
        _refuse_if_silent(self._world)
        return self._world.temperature_c


class SimBattery:
    """Simulated battery gauge: port `Battery` on the state of a `World`."""

    def __init__(self, world: World) -> None:
        self._world = world

    def read(self) -> BatteryState:
        """Return the battery's state; BusFault while the fault "bus.silent" is active."""
        _refuse_if_silent(self._world)
        return self._world.battery_state


class SimHeadMemory:
    """Simulated head memory: port `HeadMemory` on the state of a `World`, lost with the process."""

    def __init__(self, world: World) -> None:
        self._world = world

    def read(self) -> HeadIdentity | None:
        """Return the stored identity, None if never written; BusFault while the fault "bus.silent" is active."""
        _refuse_if_silent(self._world)
        return self._world.identity

    def write(self, identity: HeadIdentity) -> None:
        """Store the identity in the World; BusFault while the fault "bus.silent" is active."""
        _refuse_if_silent(self._world)
        self._world.identity = identity


def _refuse_if_silent(world: World) -> None:
    """Raise BusFault while the fault "bus.silent" is active."""
    if world.has_fault("bus.silent"):
        raise BusFault("no chip of the simulated head answers")


class SimButton:
    """Simulated shutter button: port `Button` on the state of a `World`."""

    def __init__(self, world: World) -> None:
        self._world = world

    def pressed_since_s(self) -> float | None:
        """Return the clock time since which the button is pressed, None while released; BusFault with "bus.silent"."""
        _refuse_if_silent(self._world)
        return self._world.pressed_since_s
