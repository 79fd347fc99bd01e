"""What an effect is: a name, a size that is told without rendering, and a change to a setup."""

from typing import Protocol

from device.sim.setup import Scene, Setup, Size


class Effect(Protocol):
    """One thing that light, eye or sensor do to a picture. A module with these names is one."""

    @property
    def name(self) -> str:
        """What it is called in plans and on the command line."""

    def size(self, scene: Scene) -> Size:
        """How much it would change the picture of this scene: a closed form, nothing is rendered."""

    def apply(self, setup: Setup) -> None:
        """Change the setup; no change if the size is 0."""
