"""Absent lamp of a bench head, whose scene is lit by a screen or a room."""

from device.errors import LightFault
from device.ports import LightContext
from device.values import Illumination


class NoLight:
    """Lamp of the backend "none" that implements `ports.Light`: always dark; turning it on is refused."""

    @property
    def illumination(self) -> Illumination | None:
        """None: always dark."""
        return None

    def on(self, illumination: Illumination) -> LightContext:
        """Raise LightFault: there is no lamp."""
        raise LightFault(
            f"this head has no lamp, so it cannot light in {illumination.colour}",
            "Take frames in the light that is there: diffuscope frame --head HEAD -o raw.tiff.",
        )

    def off(self) -> None:
        """Do nothing."""
