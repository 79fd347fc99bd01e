"""Figures of the traced relay: beam walk over the iris, tolerances, field curvature, distortion, illumination.

Field angles are those of the beam that leaves the eye; the field lies across the tilt of the plate (y) unless stated
(OPTICS.md 6).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import asin, atan, cos, degrees, hypot, inf, pi, radians, sin, tan

import numpy as np

from device.errors import SpecError
from device.optics.lens_data import LayoutSpec, lens_surfaces
from device.optics.light_path import LightPath
from device.optics.ray_trace import Paraxial, Points, Rays, Surface, at_plane, moved, paraxial, rays, trace
from device.optics.traced_relay import NEAR_DEG, traced_relay, without_rims

RIM = 180  # rays on the rim of the pupil, which bound the beam
CLOSE_RAD = 1e-4  # between the close rays of a focus
# Half ranges of a built relay (OPTICS.md 6.3): focal lengths by the maker's 1 %, places by hand and ruler [estimate].
TOLERANCES = {
    "gap_mm": 0.25,
    "separation_mm": 0.5,
    "pupil_axial_mm": 1.0,
    "pupil_lateral_mm": 0.3,
    "iris_axial_mm": 0.5,
    "first_scale": 0.01,
    "second_scale": 0.01,
}
SPIRAL = pi * (3 - 5**0.5)  # golden angle: points of a disc without rows


@dataclass(frozen=True)
class Deviation:
    """Deviation of a built relay from its layout: distances in mm, focal lengths as a factor; 0 and 1 by default."""

    gap_mm: float = 0.0
    separation_mm: float = 0.0
    pupil_axial_mm: float = 0.0  # positive: the eye too far from the lenses
    pupil_lateral_mm: float = 0.0
    iris_axial_mm: float = 0.0
    first_scale: float = 1.0
    second_scale: float = 1.0


@dataclass(frozen=True)
class BuiltRelay:
    """Relay as built, with the pupil's nominal place at z = 0, and the model eye on its other side."""

    surfaces: tuple[Surface, ...]  # both pairs and the plate
    lamp_surfaces: tuple[Surface, ...]  # both pairs
    iris_at_mm: float
    lamp_at_mm: float
    first: Paraxial
    second: Paraxial
    pupil_mm: float
    iris_mm: float
    deviation: Deviation

    @cached_property
    def axis_mm(self) -> Points:
        """Place (x, y) of the axial ray in the plane of the iris; the iris is centred on it."""
        return np.asarray(self._at_iris(np.zeros((1, 2)), 0.0, 90.0, blocked=False)[0])

    def _at_iris(self, heights_mm: np.ndarray, angle_deg: float, azimuth_deg: float, blocked: bool) -> Points:
        """Return (x, y) in the iris plane of parallel rays through points of the pupil; `blocked`: by lens rims."""
        turn = radians(azimuth_deg)
        out = radians(angle_deg)
        direction = np.array([sin(out) * cos(turn), sin(out) * sin(turn), cos(out)])
        off = np.array([cos(turn), sin(turn)]) * self.deviation.pupil_lateral_mm
        starts = np.column_stack([heights_mm + off, np.full(len(heights_mm), -self.deviation.pupil_axial_mm)])
        surfaces = self.surfaces if blocked else without_rims(self.surfaces)
        return np.asarray(at_plane(trace(surfaces, rays(starts, direction)), self.iris_at_mm)[:, :2])

    def beam_mm(self, angle_deg: float, azimuth_deg: float = 90.0) -> Points:
        """Return the outline of the beam around the iris's centre, (RIM, 2), mm; no lens rim blocks it."""
        turn = np.arange(RIM) * (2 * pi / RIM)
        rim = self.pupil_mm / 2 * np.column_stack([np.cos(turn), np.sin(turn)])
        return np.asarray(self._at_iris(rim, angle_deg, azimuth_deg, blocked=False) - self.axis_mm)

    def walk_mm(self, angle_deg: float, azimuth_deg: float = 90.0) -> float:
        """Return the distance of the middle of the beam (mean over the pupil) from the iris's centre, mm."""
        points = self._at_iris(_disc(400, self.pupil_mm / 2), angle_deg, azimuth_deg, blocked=False)
        return float(np.hypot(*(points.mean(axis=0) - self.axis_mm)))

    def lit_share(self, angle_deg: float, azimuth_deg: float = 90.0, count: int = 4000) -> float:
        """Return the share of the iris's area (`count` points of it) inside the outline of the beam, 0 to 1."""
        iris = _disc(count, self.iris_mm / 2)
        return float(_inside(iris, self.beam_mm(angle_deg, azimuth_deg)).mean())

    def filled_to_deg(self) -> float:
        """Return the largest field angle at which the beam's outline still encloses the iris, degrees; 0 if none."""
        low, high = 0.0, 40.0
        for _ in range(14):
            middle = (low + high) / 2
            outline = self.beam_mm(middle)
            clear = np.hypot(*outline.T).min() >= self.iris_mm / 2
            fills = bool(clear and _inside(np.zeros((1, 2)), outline)[0])
            low, high = (middle, high) if fills else (low, middle)
        return low

    def passed_share(self, angle_deg: float, azimuth_deg: float = 90.0, count: int = 20_000) -> float:
        """Return the share of a beam's `count` rays that pass the clear apertures of all lenses and the iris."""
        points = self._at_iris(_disc(count, self.pupil_mm / 2), angle_deg, azimuth_deg, blocked=True)
        inside = np.hypot(*(points - self.axis_mm).T) <= self.iris_mm / 2
        return float(inside.sum() / count)

    def angle_behind_deg(self, angle_deg: float) -> float:
        """Return the angle behind the relay of the ray through the pupil's middle, degrees."""
        out = radians(angle_deg)
        beam = trace(without_rims(self.surfaces), rays(np.zeros((1, 3)), np.array([0, sin(out), cos(out)])))
        return degrees(abs(asin(float(beam.directions[0, 1]))))

    def lamp_ray(self, led_mm: float, angle_deg: float) -> tuple[float, float]:
        """Return height at the pupil (mm) and angle (degrees) of an LED's ray; (inf, inf) if a lens rim blocks it.

        The LED is `led_mm` off its axis, and the ray at `angle_deg` to it.
        """
        start = np.array([[0, led_mm, -self.lamp_at_mm]])
        beam = trace(
            reversed_surfaces(self.lamp_surfaces),
            rays(start, np.array([0, sin(radians(angle_deg)), cos(radians(angle_deg))])),
        )
        if not len(beam.numbers):
            return inf, inf
        return float(at_plane(beam, 0.0)[0, 1]), degrees(asin(float(beam.directions[0, 1])))


def built_relay(path: LightPath, deviation: Deviation = Deviation()) -> BuiltRelay:
    """Return the relay of a light path with the deviations of a built one. SpecError as for `traced_relay`.

    The tube is made for the nominal lenses: lenses of other focal lengths stand in the nominal places.
    """
    nominal = traced_relay(path)
    layout = _layout(path)
    layout = layout.model_copy(update={"gap_mm": layout.gap_mm + deviation.gap_mm})
    spaced = traced_relay(path.model_copy(update={"layout": layout}))
    half = len(spaced.lamp_surfaces) // 2
    first, second = spaced.lamp_surfaces[:half], moved(spaced.lamp_surfaces[half:], deviation.separation_mm)
    plate = moved(spaced.surfaces[2 * half :], deviation.separation_mm)
    lamp = (*_scaled(first, deviation.first_scale), *_scaled(second, deviation.second_scale))
    return BuiltRelay(
        (*lamp, *plate),
        lamp,
        nominal.iris_at_mm + deviation.iris_axial_mm,
        second[-1].at_mm + paraxial(second).back_mm,
        paraxial(first),
        paraxial(second),
        path.eye.pupil_mm,
        path.optics.iris_um / 1000,
        deviation,
    )


def _layout(path: LightPath) -> LayoutSpec:
    assert path.layout is not None, "the figures are those of real lenses"
    return path.layout


def _scaled(surfaces: Sequence[Surface], scale: float) -> tuple[Surface, ...]:
    """Return surfaces with all radii scaled, which scales the focal length of thin lenses by the same factor."""
    return tuple(replace(surface, radius_mm=surface.radius_mm * scale) for surface in surfaces)


def reversed_surfaces(surfaces: Sequence[Surface], index_before: float = 1.0) -> tuple[Surface, ...]:
    """Return the same surfaces as light from behind meets them: mirrored at z = 0, in the opposite order."""
    before = [index_before, *(surface.index_behind for surface in surfaces[:-1])]
    return tuple(
        replace(
            surface, at_mm=-surface.at_mm, radius_mm=-surface.radius_mm, index_behind=index, tilt_deg=-surface.tilt_deg
        )
        for surface, index in zip(reversed(surfaces), reversed(before), strict=True)
    )


def paths(surfaces: Sequence[Surface], beam: Rays, index_before: float = 1.0) -> Points:
    """Return the points of rays at their start and on each surface, (surfaces + 1, rays, 3), mm, for drawings.

    SpecError as for `trace`, and for a ray that an aperture blocks.
    """
    points = [beam.points_mm]
    for surface in surfaces:
        after = trace([surface], beam, index_before)
        if len(after.numbers) < len(beam.numbers):
            raise SpecError(f"a ray is blocked at {surface.name}", "Draw surfaces without clear apertures.")
        beam = after
        index_before = surface.index_behind
        points.append(beam.points_mm)
    return np.array(points)


def _disc(count: int, radius_mm: float) -> np.ndarray:
    """Return points that fill a disc evenly, with their mean in its middle, (count, 2), mm; `count` is even."""
    k = np.arange(count // 2)
    reach = radius_mm * np.sqrt((k + 0.5) / (count // 2))
    turn = SPIRAL * k
    half = np.column_stack([reach * np.cos(turn), reach * np.sin(turn)])
    return np.concatenate([half, -half])


def _inside(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Return for each point whether it lies inside a closed outline (even-odd rule), bool (points,)."""
    x = points[:, :1]
    y = points[:, 1:]
    (x1, y1) = outline.T
    (x2, y2) = np.roll(outline, -1, axis=0).T
    crossing = (y1 > y) != (y2 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        right = x < x1 + (y - y1) * (x2 - x1) / (y2 - y1)
    return np.asarray((crossing & right).sum(axis=1) % 2 == 1)


@dataclass(frozen=True)
class FieldPoint:
    """A point of the model eye's retina: field angle, height, and the vergence of its beam at the pupil, in dioptres.

    Positive: the beam that leaves the eye converges, as that of a myopic eye does.
    """

    angle_deg: float
    height_mm: float
    sagittal_dpt: float
    tangential_dpt: float


def retina_point(
    path: LightPath, angle_deg: float, retina_radius_mm: float | None = None, eye_to_screen_mm: float | None = None
) -> FieldPoint:
    """Return the point of the model eye's retina that a beam at an angle comes from, and the vergence of that beam.

    `retina_radius_mm`: radius of the concave retina (default: the layout's; inf: a flat screen). `eye_to_screen_mm`:
    distance from the lens to its vertex (default: the paraxial focus).
    """
    layout = _layout(path)
    lens = moved(
        lens_surfaces(path.lens, path.glass, layout.eye_lens, path.optics.wavelength_um),
        layout.pupil_to_eye_lens_mm,
    )
    at_mm = lens[-1].at_mm + (eye_to_screen_mm or paraxial(lens).back_mm)
    retina = Surface(at_mm, -(retina_radius_mm or layout.retina_radius_mm), 1.0, name="the retina")
    inward = without_rims((*lens, retina))
    out = radians(angle_deg)
    chief = trace(inward, rays(np.zeros((1, 3)), np.array([0, sin(out), cos(out)])))
    point = chief.points_mm[0]
    towards = -chief.directions[0]
    across = np.array([1.0, 0, 0])
    along = np.cross(across, towards)
    fan = np.array([towards + step * side for side in (across, along) for step in (-CLOSE_RAD, CLOSE_RAD)])
    mirror = np.array([1, 1, -1])
    back = trace(without_rims(reversed_surfaces(lens)), rays(np.tile(point * mirror, (4, 1)), fan * mirror))
    heights = at_plane(back, 0.0)
    slopes = back.directions
    sagittal = -(slopes[1, 0] - slopes[0, 0]) / (heights[1, 0] - heights[0, 0])
    wide = (heights[3, 1] - heights[2, 1]) * cos(out)  # of the beam across its own direction
    turned = np.cross(slopes[2], slopes[3])[0] * -1
    tangential = -turned / wide
    return FieldPoint(angle_deg, hypot(point[0], point[1]), 1000 * float(sagittal), 1000 * float(tangential))


def built_relays(path: LightPath, count: int, seed: int) -> Iterator[BuiltRelay]:
    """Yield relays with random deviations, uniform within TOLERANCES, for a Monte Carlo study; repeatable by `seed`."""
    rng = np.random.default_rng(seed)
    names = list(TOLERANCES)
    reach = np.array(list(TOLERANCES.values()))
    for _ in range(count):
        drawn = dict(zip(names, (rng.uniform(-1, 1, len(reach)) * reach).tolist(), strict=True))
        scales = {name: 1 + drawn[name] for name in ("first_scale", "second_scale")}
        yield built_relay(path, Deviation(**{**drawn, **scales}))


def field_of_cone_deg(relay: BuiltRelay, cone_deg: float, led_mm: float) -> float:
    """Return the full field, degrees, that the cone of an LED lights, both edges traced through the relay."""
    edges = [relay.lamp_ray(led_mm, side * cone_deg / 2)[1] for side in (-1, 1)]
    return abs(edges[1] - edges[0])


def displacement_error(relay: BuiltRelay, angle_deg: float) -> tuple[float, float]:
    """Return by how much the traced displacement on the sensor is larger than two formulas have it, at a field angle.

    Relative, negative: smaller. The displacement is f_d tan(angle behind the relay); the formulas are the paper's,
    f_d a angle (rad), and an ideal relay's, f_d a tan(angle), with a of angles near the axis.
    """
    near = relay.angle_behind_deg(NEAR_DEG) / NEAR_DEG
    traced = tan(radians(relay.angle_behind_deg(angle_deg)))
    return traced / (near * radians(angle_deg)) - 1, traced / (near * tan(radians(angle_deg))) - 1


def f_theta_error(relay: BuiltRelay, angle_deg: float) -> tuple[float, float]:
    """Return by how much the traced angle behind the relay is larger than two laws have it, at a field angle.

    Relative, negative: smaller. Both compare angles; the displacement on a flat sensor is the tangent of the angle
    (`displacement_error`). Linear: angle behind = a angle. Tangent: tan(angle behind) = a tan(angle), with a of angles
    near the axis.
    """
    near = relay.angle_behind_deg(NEAR_DEG) / NEAR_DEG
    far = relay.angle_behind_deg(angle_deg)
    ideal = degrees(atan(near * tan(radians(angle_deg))))
    return far / (near * angle_deg) - 1, far / ideal - 1
