"""Interface of a simulated effect: a name, a size in closed form and a change to the optical setup."""

from typing import Protocol, runtime_checkable

from device.sim.optical_setup import OpticalSetup, Scene, Size


@runtime_checkable
class Effect(Protocol):
    """Physical effect of illumination, eye, optics or sensor on a frame."""

    @property
    def name(self) -> str:
        """Name in plans and on the command line."""

    def size(self, scene: Scene) -> Size:
        """Return eta, the change of this scene's reconstruction over its noise, and the reason; nothing is rendered."""

    def apply(self, setup: OpticalSetup) -> None:
        """Add the effect to the setup, in place; an effect of size 0 does not change the rendered frame."""
