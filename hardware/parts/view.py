"""How parts become lines of an SVG: seen from a direction, hidden lines left out; or cut along the axis."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil

from build123d import Edge, GeomType, Location, Part, Plane, Vector
from manifold3d import CrossSection

from hardware.parts.solids import solid

Place = tuple[float, float]
Offset = tuple[float, float, float]
EPSILON_MM = 0.03  # what a drawing may leave out
LONG_MM = 0.8  # of a bend, drawn as a straight line
FAR_MM = 1000.0
HAIR_MM = 0.02


@dataclass(frozen=True)
class Drawn:
    """One part in a drawing: its SVG, and the box that it fills, in mm with y upwards."""

    svg: str
    left: float
    low: float
    right: float
    high: float
    depth: float = 0.0
    marks: tuple[Place, ...] = ()  # places on it at which a label may point

    @property
    def middle(self) -> Place:
        """The middle of its box."""
        return (self.left + self.right) / 2, (self.low + self.high) / 2


@dataclass(frozen=True)
class View:
    """A camera far away: `toward` points from the parts to it, `up` is up in the picture."""

    toward: Offset
    up: Offset = (0.0, 1.0, 0.0)

    @property
    def frame(self) -> Location:
        """From the head's coordinates to the picture's: x to the right, y up, z to the viewer."""
        right = Vector(*self.up).cross(Vector(*self.toward))
        return Plane((0, 0, 0), x_dir=right, z_dir=self.toward).location.inverse()

    def seen(self, part: Part, kind: str, offset: Offset = (0, 0, 0)) -> Drawn:
        """The part's silhouette in the class's colour, and the edges that are not hidden by itself."""
        turned = part.moved(Location(offset)).moved(self.frame)
        outline = solid(turned).project().simplify(EPSILON_MM)
        edges, _ = turned.project_to_viewport((0, 0, FAR_MM), (0, 1, 0), (0, 0, 0))
        lines = " ".join(_path(_points(edge), closed=False) for edge in edges)
        box = turned.bounding_box()
        svg = f'<path class="{kind}" d="{_area(outline)}"/><path class="fine" d="{lines}"/>'
        return Drawn(svg, box.min.X, box.min.Y, box.max.X, box.max.Y, box.center().Z)


def cut(part: Part, kind: str, offset: Offset = (0, 0, 0), at_x_mm: float = 0.0) -> Drawn | None:
    """What a cut along the axis, at one x, shows: z to the right, y up; None where it misses the part."""
    lying = solid(part.moved(Location(offset))).rotate((0, -90, 0))  # x becomes z, z becomes -x
    face = lying.slice(at_x_mm).mirror((1, 0)).simplify(EPSILON_MM)
    if face.is_empty():
        return None
    svg = f'<path class="{kind}" d="{_area(face)}"/>'
    left, low, right, high = face.bounds()
    return Drawn(svg, left, low, right, high, marks=tuple(_marks(face)))


def _marks(face: CrossSection) -> Iterator[Place]:
    """Middles of what upright lines through every piece meet of it."""
    for piece in face.decompose():
        left, low, right, high = piece.bounds()
        for part in (0.3, 0.5, 0.7):
            upright = CrossSection.square((HAIR_MM, high - low)).translate((left + part * (right - left), low))
            for met in (piece ^ upright).decompose():
                x0, y0, x1, y1 = met.bounds()
                yield (x0 + x1) / 2, (y0 + y1) / 2


def _points(edge: Edge) -> list[Place]:
    count = 1 if edge.geom_type == GeomType.LINE else max(4, min(48, ceil(edge.length / LONG_MM)))
    places = [edge.position_at(i / count) for i in range(count + 1)]
    return [(place.X, place.Y) for place in places]


def _area(face: CrossSection) -> str:
    return " ".join(_path(corners.tolist(), closed=True) for corners in face.to_polygons())


def _path(places: list[Place], closed: bool) -> str:
    rounded = [f"{x:.1f} {-y:.1f}".replace("-0.0", "0.0") for x, y in places]
    kept = [place for i, place in enumerate(rounded) if i == 0 or place != rounded[i - 1]]
    return "M" + "L".join(kept) + ("Z" if closed else "") if len(kept) > 1 else ""
