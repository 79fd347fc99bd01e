"""Sequential ray trace through spherical and plane surfaces on one axis, and their paraxial matrix (OPTICS.md 6).

z runs along the axis, x and y across it, all in mm. A radius is positive if the centre of curvature lies behind the
surface. A ray outside a clear aperture is blocked and not traced farther. A ray that misses a sphere, or that is
totally reflected, is an error: no coordinate is ever NaN.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, inf, isinf, radians, sin
from typing import NamedTuple

import numpy as np

from device.errors import SpecError

Points = np.ndarray  # float64 (rays, 3): x, y, z
_NARROWER = "Trace a narrower beam or a smaller angle, or correct the radius of that surface."


@dataclass(frozen=True)
class Surface:
    """One refracting surface: vertex on the axis, radius (inf: plane), index behind it, diameter of its clear aperture.

    `tilt_deg` turns a plane around the y axis, so that its normal leaves the axis towards x.
    """

    at_mm: float
    radius_mm: float
    index_behind: float
    clear_mm: float = inf
    tilt_deg: float = 0.0
    name: str = "surface"


class Rays(NamedTuple):
    """Rays: points and unit directions, (rays, 3) each, and the number that each ray had at the start, (rays,)."""

    points_mm: Points
    directions: Points
    numbers: np.ndarray


def rays(points_mm: Points, directions: Points) -> Rays:
    """Return rays numbered from 0; directions are scaled to length 1. SpecError for values that are not finite."""
    points = np.atleast_2d(np.asarray(points_mm, np.float64))
    towards = np.broadcast_to(np.atleast_2d(np.asarray(directions, np.float64)), points.shape)
    length = np.linalg.norm(towards, axis=1, keepdims=True)
    if not (np.isfinite(points).all() and np.isfinite(towards).all() and (length > 0).all()):
        raise SpecError("a ray has no finite place or direction", "Give finite coordinates and a direction.")
    return Rays(points, towards / length, np.arange(len(points)))


def trace(surfaces: Sequence[Surface], beam: Rays, index_before: float = 1.0) -> Rays:
    """Return the rays behind the last surface, on it; rays outside a clear aperture are left out.

    SpecError names the surface that a ray misses or at which it is totally reflected.
    """
    for surface in surfaces:
        beam, normals = _meet(surface, beam)
        beam = beam._replace(directions=_refract(surface, beam, normals, index_before))
        index_before = surface.index_behind
    return beam


def at_plane(beam: Rays, at_mm: float) -> Points:
    """Return the points of rays in the plane z = `at_mm`, (rays, 3)."""
    steps = (at_mm - beam.points_mm[:, 2]) / beam.directions[:, 2]
    return np.asarray(beam.points_mm + beam.directions * steps[:, None])


def _meet(surface: Surface, beam: Rays) -> tuple[Rays, Points]:
    """Return the rays where they meet a surface, within its clear aperture, and the unit normals along the light."""
    points = beam.points_mm
    towards = beam.directions
    if isinf(surface.radius_mm):
        turn = radians(surface.tilt_deg)
        normals = np.broadcast_to([sin(turn), 0.0, cos(turn)], points.shape)
        steps = ((np.array([0, 0, surface.at_mm]) - points) * normals).sum(1) / (towards * normals).sum(1)
    else:
        steps = _to_sphere(surface, points, towards)
    points = points + towards * steps[:, None]
    if not isinf(surface.radius_mm):
        normals = (np.array([0, 0, surface.at_mm + surface.radius_mm]) - points) / surface.radius_mm
    across = points - np.array([0, 0, surface.at_mm])
    span = (
        3 if isinf(surface.radius_mm) else 2
    )  # an aperture is round in the plane of a plate, across the axis of a lens
    offset = np.linalg.norm(across[:, :span], axis=1)
    passed = offset <= surface.clear_mm / 2
    return Rays(points[passed], towards[passed], beam.numbers[passed]), np.asarray(normals[passed])


def _to_sphere(surface: Surface, points: Points, towards: Points) -> np.ndarray:
    """Return each ray's distance to the sphere, at the crossing nearer to the vertex, (rays,)."""
    from_centre = points - np.array([0, 0, surface.at_mm + surface.radius_mm])
    along = (from_centre * towards).sum(1)
    under = along**2 - (from_centre**2).sum(1) + surface.radius_mm**2
    if (under < 0).any():
        number = int(np.flatnonzero(under < 0)[0])
        raise SpecError(f"ray {number} misses {surface.name}, a sphere of {surface.radius_mm:g} mm", _NARROWER)
    side = np.sign(surface.radius_mm) * np.sign(towards[:, 2])
    return np.asarray(-along - side * np.sqrt(under))


def _refract(surface: Surface, beam: Rays, normals: Points, index_before: float) -> Points:
    """Return the directions behind a surface by Snell's law in vector form, (rays, 3)."""
    ratio = index_before / surface.index_behind
    facing = (beam.directions * normals).sum(1)
    normals = normals * np.sign(facing)[:, None]
    into = np.abs(facing)
    under = 1 - ratio**2 * (1 - into**2)
    if (under < 0).any():
        number = int(beam.numbers[np.flatnonzero(under < 0)[0]])
        raise SpecError(f"ray {number} is totally reflected at {surface.name}", _NARROWER)
    return np.asarray(ratio * beam.directions + (np.sqrt(under) - ratio * into)[:, None] * normals)


def moved(surfaces: Sequence[Surface], by_mm: float) -> tuple[Surface, ...]:
    """Return the surfaces moved along the axis."""
    return tuple(replace(surface, at_mm=surface.at_mm + by_mm) for surface in surfaces)


class Paraxial(NamedTuple):
    """Focal length, and distances from the last vertex to the rear and from the front focus to the first vertex, mm."""

    focal_mm: float
    back_mm: float
    front_mm: float


def paraxial(surfaces: Sequence[Surface], index_before: float = 1.0) -> Paraxial:
    """Return the cardinal distances of surfaces in air, from the product of their 2 x 2 matrices of height and slope.

    SpecError for a system without power.
    """
    matrix = np.eye(2)
    at_mm = surfaces[0].at_mm
    for surface in surfaces:
        matrix = np.array([[1, surface.at_mm - at_mm], [0, 1]]) @ matrix
        ratio = index_before / surface.index_behind
        matrix = np.array([[1, 0], [(ratio - 1) / surface.radius_mm, ratio]]) @ matrix
        index_before = surface.index_behind
        at_mm = surface.at_mm
    (a, _), (c, d) = matrix
    if abs(c) < 1e-12:
        raise SpecError("these surfaces have no focus", "Give a lens with a power other than zero.")
    return Paraxial(float(-1 / c), float(-a / c), float(-d / c))
