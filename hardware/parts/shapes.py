"""Rods, boxes and screw patterns in the head's own coordinates, so that a part's file reads as its drawing."""

from collections.abc import Iterable

from build123d import Axis, Part, Plane, Solid, Vector, chamfer

Place = tuple[float, float]
Range = tuple[float, float]


def rod(wide_mm: float, z_mm: Range, at_mm: Place = (0, 0)) -> Part:
    """A cylinder along z."""
    return _rod(wide_mm, Vector(*at_mm, z_mm[0]), Vector(*at_mm, z_mm[1]))


def rod_y(wide_mm: float, y_mm: Range, at_mm: Place) -> Part:
    """A cylinder along y, at (x, z)."""
    x, z = at_mm
    return _rod(wide_mm, Vector(x, y_mm[0], z), Vector(x, y_mm[1], z))


def rod_x(wide_mm: float, x_mm: Range, at_mm: Place) -> Part:
    """A cylinder along x, at (y, z)."""
    return _rod(wide_mm, Vector(x_mm[0], *at_mm), Vector(x_mm[1], *at_mm))


def _rod(wide_mm: float, begin: Vector, end: Vector) -> Part:
    along = end - begin
    return Part() + Solid.make_cylinder(wide_mm / 2, along.length, Plane(begin, z_dir=along))


def cone(begin_mm: float, end_mm: float, z_mm: Range, at_mm: Place = (0, 0)) -> Part:
    """A cone along z, from one diameter to another."""
    begin, end = z_mm
    along = Plane((*at_mm, begin), z_dir=(0, 0, 1 if end > begin else -1))
    return Part() + Solid.make_cone(begin_mm / 2, end_mm / 2, abs(end - begin), along)


def box(x_mm: Range, y_mm: Range, z_mm: Range, chamfer_mm: float = 0, along: Axis = Axis.Z) -> Part:
    """A box between faces; `chamfer_mm` breaks the four edges that run `along` an axis."""
    sizes = [abs(b - a) for a, b in (x_mm, y_mm, z_mm)]
    made = Part() + Solid.make_box(*sizes, Plane((min(x_mm), min(y_mm), min(z_mm))))
    return chamfer(made.edges().filter_by(along), chamfer_mm) if chamfer_mm else made


def square(wide_mm: float, z_mm: Range, chamfer_mm: float = 0) -> Part:
    """A square plate around the axis."""
    side = (-wide_mm / 2, wide_mm / 2)
    return box(side, side, z_mm, chamfer_mm)


def joined(parts: Iterable[Part]) -> Part:
    """All of them as one."""
    whole = Part()
    for part in parts:
        whole += part
    return whole
