"""The chips of a simulated head: they tell what the shared world says."""

from device.errors import BusFault
from device.sim.world import World
from device.values import Charge, Identity


class SimThermometer:
    """A Thermometer in a World."""

    def __init__(self, world: World) -> None:
        self._world = world

    def read_c(self) -> float:
        """Degrees Celsius now; BusFault while the fault "bus.silent" lasts."""
        _refuse_silence(self._world)
        return self._world.celsius


class SimBattery:
    """A Battery in a World."""

    def __init__(self, world: World) -> None:
        self._world = world

    def read(self) -> Charge:
        """How full it is."""
        _refuse_silence(self._world)
        return self._world.charge


class SimHeadMemory:
    """A HeadMemory in a World."""

    def __init__(self, world: World) -> None:
        self._world = world

    def read(self) -> Identity | None:
        """What it holds."""
        _refuse_silence(self._world)
        return self._world.identity

    def write(self, identity: Identity) -> None:
        """Keep this from now on."""
        _refuse_silence(self._world)
        self._world.identity = identity


def _refuse_silence(world: World) -> None:
    if world.broken("bus.silent"):
        raise BusFault("no chip of the simulated head answers")


class SimButton:
    """A Button in a World."""

    def __init__(self, world: World) -> None:
        self._world = world

    def pressed_since_s(self) -> float | None:
        """Since when somebody in the world presses it."""
        _refuse_silence(self._world)
        return self._world.pressed_since_s
