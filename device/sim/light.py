"""The simulated LED ring: it lights the shared world, and nothing else."""

from types import TracebackType

from device.errors import LightFault
from device.ports import Light, Lit
from device.sim.world import World
from device.values import Glow


class SimLight:
    """A lamp in a World; dark unless a context holds it on."""

    def __init__(self, world: World) -> None:
        self._world = world

    @property
    def glow(self) -> Glow | None:
        """What it shines now; None when it is dark."""
        return self._world.glow

    def on(self, glow: Glow) -> "SimLit":
        """Shine from the entry of the returned context to its end; a context that is never entered stays dark.

        Raises LightFault while the world's fault "light.fault" lasts, and is then dark.
        """
        self.check()
        return SimLit(self, glow)

    def off(self) -> None:
        """Be dark; always allowed, harmless when it is dark already.

        LightFault while the world's fault "light.silent" lasts: LEDs keep their last colour when nobody reaches them.
        """
        self._hear()
        self._world.glow = None

    def _hear(self) -> None:
        if self._world.broken("light.silent"):
            raise LightFault("the simulated lamp does not hear what it is told")

    def shine(self, glow: Glow) -> None:
        """Shine now; for the context only."""
        self.check()
        self._hear()
        self._world.glow = glow

    def check(self) -> None:
        """Raise LightFault, dark, if the ring is broken."""
        if self._world.broken("light.fault"):
            self.off()
            raise LightFault("the simulated lamp does not answer")


class SimLit:
    """The time in which the lamp shines."""

    def __init__(self, light: SimLight, glow: Glow) -> None:
        self._light = light
        self._glow = glow

    def __enter__(self) -> "SimLit":
        """The lamp is on."""
        self._light.shine(self._glow)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """The lamp is off, whatever happened."""
        self._light.off()


class Mirrored:
    """A real lamp in front of a simulated camera: the world sees what the lamp was told to show."""

    def __init__(self, lamp: Light, world: World) -> None:
        self._lamp, self._world = lamp, world

    @property
    def glow(self) -> Glow | None:
        """What it shines now; None when it is dark."""
        return self._lamp.glow

    def on(self, glow: Glow) -> Lit:
        """Shine from the entry of the returned context to its end, lamp and world together."""
        return MirroredLit(self, self._lamp.on(glow))

    def off(self) -> None:
        """Be dark."""
        self._world.glow = None
        self._lamp.off()

    def reflect(self) -> None:
        """The world sees what the lamp shows; for the context only."""
        self._world.glow = self._lamp.glow


class MirroredLit:
    """The time in which both shine."""

    def __init__(self, light: Mirrored, lit: Lit) -> None:
        self._light, self._lit = light, lit

    def __enter__(self) -> "MirroredLit":
        """The lamp is on."""
        self._lit.__enter__()
        self._light.reflect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """The lamp is off, whatever happened."""
        self._light.off()
