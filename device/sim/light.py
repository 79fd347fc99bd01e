"""Simulated LED ring, and a real LED ring whose state a simulated camera uses."""

from collections.abc import Callable
from types import TracebackType

from device.errors import LightFault
from device.ports import Light
from device.sim.world import World
from device.values import Illumination


class LampContext:
    """Context manager during which a lamp is on: calls `turn_on` on entry, and `turn_off` at every exit."""

    def __init__(self, turn_on: Callable[[], None], turn_off: Callable[[], None]) -> None:
        self._turn_on, self._turn_off = turn_on, turn_off

    def __enter__(self) -> "LampContext":
        """Turn the lamp on."""
        self._turn_on()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Turn the lamp off, also after an exception."""
        self._turn_off()


class SimLight:
    """Simulated lamp of a World; dark outside a context of `on`."""

    def __init__(self, world: World) -> None:
        self._world = world

    @property
    def illumination(self) -> Illumination | None:
        """Present illumination; None when dark."""
        return self._world.illumination

    def on(self, illumination: Illumination) -> LampContext:
        """Return a context during which the lamp is on; a context that is never entered stays dark.

        LightFault, here or on entry, while the fault "light.fault" is active; the lamp is then dark. LightFault on
        entry while "light.silent" is active.
        """
        self.check()
        return LampContext(lambda: self._turn_on(illumination), self.off)

    def off(self) -> None:
        """Turn the lamp off; idempotent.

        LightFault while the fault "light.silent" is active: LEDs that receive no command keep their last colour.
        """
        self._refuse_if_silent()
        self._world.illumination = None

    def _refuse_if_silent(self) -> None:
        """Raise LightFault while the fault "light.silent" is active: commands do not reach the LEDs."""
        if self._world.has_fault("light.silent"):
            raise LightFault("the simulated lamp does not hear what it is told")

    def _turn_on(self, illumination: Illumination) -> None:
        """Turn the lamp on; LightFault while "light.fault" or "light.silent" is active."""
        self.check()
        self._refuse_if_silent()
        self._world.lit_frames = 0
        self._world.illumination = illumination

    def check(self) -> None:
        """Turn the lamp off and raise LightFault while the fault "light.fault" is active."""
        if self._world.has_fault("light.fault"):
            self.off()
            raise LightFault("the simulated lamp does not answer")


class MirroredLight:
    """Real lamp whose illumination is copied to the `World` of a simulated camera."""

    def __init__(self, lamp: Light, world: World) -> None:
        self._lamp, self._world = lamp, world

    @property
    def illumination(self) -> Illumination | None:
        """Present illumination; None when dark."""
        return self._lamp.illumination

    def on(self, illumination: Illumination) -> LampContext:
        """Return a context during which the lamp is on, in hardware and in the World."""
        lit = self._lamp.on(illumination)

        def turn_on() -> None:
            lit.__enter__()
            self._world.lit_frames = 0
            self._world.illumination = self._lamp.illumination

        return LampContext(turn_on, self.off)

    def off(self) -> None:
        """Turn the lamp off, in hardware and in the World."""
        self._world.illumination = None
        self._lamp.off()
