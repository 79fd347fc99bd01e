"""The real ring over the emulated bus, seen by a simulated camera: its light is what the wire's bytes say."""

from device.clock import SystemClock
from device.drivers.guardian import Guardian
from device.drivers.ring import Apa102Ring
from device.sim.camera import SimCamera
from device.sim.world import World
from device.spec import InstrumentSpec, LightSpec
from device.values import Glow
from tests.ports.emulators.bus.client import Bus, the_bus


class WiredWorld(World):
    """A world whose lamp is the emulated chain: only what the LEDs show is seen, whatever the driver believes."""

    @property
    def glow(self) -> Glow | None:
        return seen(the_bus())

    @glow.setter
    def glow(self, glow: Glow | None) -> None:
        """Nobody here lights it but the wire."""


def seen(bus: Bus) -> Glow | None:
    """The light of the chain: the colour and drive of its brightest LED."""
    brightest = max(bus.rgb(), key=max)
    if not any(brightest):
        return None
    channel = brightest.index(max(brightest))
    return Glow(("red", "green", "blue")[channel], round(brightest[channel] / 255, 2))


def real_ring(**said: object) -> Apa102Ring:
    """The real driver with its real guardian, on the emulated bus."""
    the_bus()
    spec = LightSpec(backend="apa102", **said)
    return Apa102Ring(spec, Guardian(spec.spi_device, spec.leds))


def wired(spec: InstrumentSpec) -> tuple[SimCamera, Apa102Ring, SystemClock]:
    """A simulated camera that sees the real ring."""
    ring, clock = real_ring(max_on_s=30), SystemClock()
    world = WiredWorld(spec, clock)
    for colour in ("green", "red"):
        world.electrons_per_s(colour)
    return SimCamera(world), ring, clock
