"""Which parts there are, by the name that `parts.csv` and the guide call them, and what they make together."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path

from build123d import Location, Part, Plane

from hardware.parts import bought
from hardware.parts.dimensions import Dimensions

PRINTED = Path(__file__).parent / "printed"
ANY_EYE = {"model eye tube", "step ring", "eye collar"}
EYE = {"pinhole piston", *ANY_EYE}  # what makes the calibration's eye
CHART = {"chart piston", *ANY_EYE}  # what makes the eye that shows a retina; all others: the head


@dataclass(frozen=True)
class Printed:
    """One part that is printed: its shape where it stands in the head, and which way is up on the printer."""

    name: str
    shape: Callable[[Dimensions], Part]
    up: tuple[float, float, float]

    def on_the_bed(self, d: Dimensions) -> Part:
        """The part as it is printed: turned, and standing on z = 0 above the origin."""
        turned = self.shape(d).moved(Plane((0, 0, 0), z_dir=self.up).location.inverse())
        low = turned.bounding_box().min
        high = turned.bounding_box().max
        return turned.moved(Location((-(low.X + high.X) / 2, -(low.Y + high.Y) / 2, -low.Z)))


@cache
def printed() -> dict[str, Printed]:
    """Every file of `printed/`, by the part's name."""
    found = {}
    for file in sorted(PRINTED.glob("[a-z]*.py")):
        module = import_module(f"hardware.parts.printed.{file.stem}")
        name = file.stem.replace("_", " ").replace("led ", "LED ")
        found[name] = Printed(name, getattr(module, file.stem), module.UP)
    return found


def head(d: Dimensions) -> dict[str, Part]:
    """The head without its lenses, every part where it stands."""
    own = {name: part.shape(d) for name, part in printed().items() if name not in EYE | CHART}
    return own | {name: shape(d) for name, shape in bought.HEAD.items()}


def eye(d: Dimensions) -> dict[str, Part]:
    """The calibration's eye, its point of light in focus."""
    own = {name: part.shape(d) for name, part in printed().items() if name in EYE}
    return own | {name: shape(d) for name, shape in bought.EYE.items()}


def chart_eye(d: Dimensions) -> dict[str, Part]:
    """The same eye with the printed retina instead of the point of light, in focus."""
    own = {name: part.shape(d) for name, part in printed().items() if name in CHART}
    return own | {name: shape(d) for name, shape in bought.CHART.items()}
