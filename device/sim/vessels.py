"""Growth of retinal vessels: trunks out of the disc, arcades around the macula, branching by Murray's law.

All places are (x, y) in degrees, right and down, with the fovea at the origin and the disc at positive x (a right eye).
Arteries never cross arteries, nor veins veins; no vessel enters the avascular zone.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Kind = Literal["artery", "vein"]

DISC = (15.2, -1.5)  # nasal of the fovea, and a little above it
STEP = 0.12  # between points of a path
MIN_WIDTH_DEG = 0.05  # thinner vessels are not drawn
AVASCULAR = 1.15  # radius of the zone around the fovea
TAPER_DEG = 1.2  # at the end of a vessel
CELL = 0.3  # grid cell reserved by one vessel of a kind
MAX_TOTAL_TURN_RAD = 1.7  # largest total turn of a vessel, radians; arches are exempt
CURVATURE_LENGTH_DEG = 1.3  # correlation length of the random curvature


@dataclass(frozen=True)
class Vessel:
    """Path of one vessel: points (n, 3) of x, y and width_deg."""

    kind: Kind
    points: NDArray[np.float32]


@dataclass(frozen=True)
class Trunk:
    """Main vessel at the optic disc: heading clockwise from the right, width, and y of its arch (None: no arch)."""

    kind: Kind
    heading_deg: float
    width_deg: float
    arch: float | None


TRUNKS = (
    Trunk("vein", -100, 0.40, -8.4),
    Trunk("artery", -122, 0.30, -7.0),
    Trunk("vein", 98, 0.40, 8.2),
    Trunk("artery", 120, 0.30, 6.8),
    Trunk("vein", -42, 0.26, None),
    Trunk("artery", -66, 0.20, None),
    Trunk("vein", 46, 0.26, None),
    Trunk("artery", 68, 0.20, None),
    Trunk("artery", 176, 0.10, None),
    Trunk("vein", 190, 0.11, None),
)


@dataclass
class Tip:
    """Growing end of a vessel: `bend` is its random curvature, rad per degree, `side` that of the next branch, +-1."""

    kind: Kind
    x: float
    y: float
    heading_rad: float
    width_deg: float
    arch: float | None = None
    inward: bool = False  # towards the macula
    lineage: tuple[int, ...] = ()  # numbers of the vessel's ancestors and its own
    bend: float = 0.0
    total_turn_rad: float = 0.0  # total turn since the branch, radians
    side: int = 1


@dataclass
class GrowthState:
    """Growth state of one eye's vessels: a circle of `reach_deg` around `centre` with its occupied cells."""

    rng: np.random.Generator
    reach_deg: float
    centre: tuple[float, float]
    occupied: dict[tuple[Kind, int, int], int] = field(default_factory=dict)
    tip_count: int = 0

    def number_tip(self, tip: Tip) -> Tip:
        """Append the next number to the lineage of a new tip, and return the tip."""
        tip.lineage = (*tip.lineage, self.tip_count)
        self.tip_count += 1
        return tip

    def occupy(self, tip: Tip) -> None:
        """Mark the tip's cell as occupied by its vessel, unless a vessel of the same kind occupies it already."""
        self.occupied.setdefault((tip.kind, round(tip.x / CELL), round(tip.y / CELL)), tip.lineage[-1])

    def is_free(self, tip: Tip, turn_rad: float, ahead: float) -> bool:
        """Return true if no other vessel of the same kind occupies the cell `ahead` degrees away after a turn."""
        x = tip.x + ahead * math.cos(tip.heading_rad + turn_rad)
        y = tip.y + ahead * math.sin(tip.heading_rad + turn_rad)
        owner = self.occupied.get((tip.kind, round(x / CELL), round(y / CELL)))
        return owner is None or owner == tip.lineage[-1]

    def has_ended(self, tip: Tip) -> bool:
        """Return true if the tip is outside the circle, too thin, turned too far, at the fovea, or has passed it."""
        away = math.hypot(tip.x - self.centre[0], tip.y - self.centre[1])
        from_fovea = math.hypot(tip.x, tip.y)
        leaving = math.cos(tip.heading_rad) * tip.x + math.sin(tip.heading_rad) * tip.y > 0
        past = from_fovea < AVASCULAR or (leaving and tip.inward and from_fovea < 6)
        return (
            away > self.reach_deg
            or tip.width_deg < MIN_WIDTH_DEG
            or past
            or abs(tip.total_turn_rad) > MAX_TOTAL_TURN_RAD
        )


def grow(seed: int, reach_deg: float, centre: tuple[float, float], beyond_deg: float = 0.0) -> list[Vessel]:
    """Return the vessels of one eye within `reach_deg` of `centre` (x, y), widest first, reproducible by the seed.

    With `beyond_deg` the vessels that leave this circle are continued so far beyond it; those inside stay the same.
    """
    garden = GrowthState(np.random.default_rng((seed, 1)), reach_deg, centre)
    vessels, left = _grown(garden, [(_sprout(garden, trunk), []) for trunk in TRUNKS])
    if beyond_deg > 0:
        garden.reach_deg = reach_deg + beyond_deg
        garden.rng = np.random.default_rng((seed, 4))
        vessels += _grown(garden, left)[0]
    return vessels


Path = list[tuple[float, float, float]]


def _grown(garden: GrowthState, waiting: list[tuple[Tip, Path]]) -> tuple[list[Vessel], list[tuple[Tip, Path]]]:
    """Return the vessels that grow from tips and the ends of their paths, and the same of those that left the circle.

    The end of the path, full width over the length of a taper, is drawn again by the continuation.
    """
    vessels = []
    left = []
    while waiting:
        waiting.sort(key=lambda item: -item[0].width_deg)
        tip, before = waiting.pop(0)
        points = [*before, (tip.x, tip.y, tip.width_deg)]
        for branch in _lengthen(garden, tip, points):
            waiting.append((branch, []))
        if len(points) > 8:
            vessels.append(Vessel(tip.kind, _tapered(points, tip)))
        if math.hypot(tip.x - garden.centre[0], tip.y - garden.centre[1]) > garden.reach_deg:
            left.append((tip, points[-round(TAPER_DEG / STEP) : -1]))
    return vessels, left


def _sprout(garden: GrowthState, trunk: Trunk) -> Tip:
    """Return the tip of a main vessel at the cup of the optic disc, with random deviations from the trunk's values."""
    rng = garden.rng
    heading = math.radians(trunk.heading_deg + rng.normal(0, 6))
    arch = None if trunk.arch is None else trunk.arch + rng.normal(0, 0.5)
    x = DISC[0] + 0.35 + 0.3 * math.cos(heading)
    y = DISC[1] + 0.5 * math.sin(heading)
    side = 1 if rng.random() < 0.5 else -1
    return garden.number_tip(Tip(trunk.kind, x, y, heading, trunk.width_deg * rng.uniform(0.9, 1.1), arch, side=side))


def _lengthen(garden: GrowthState, tip: Tip, points: list[tuple[float, float, float]]) -> Iterator[Tip]:
    """Grow one vessel to its end: append its (x, y, width) to `points` and yield the tips of its branches."""
    rng = garden.rng
    until_branch = rng.uniform(2.2, 4.0)
    grown = 0.0
    while not garden.has_ended(tip):
        _steer(garden, tip, grown)
        tip.x += STEP * math.cos(tip.heading_rad)
        tip.y += STEP * math.sin(tip.heading_rad)
        tip.width_deg *= 1 - 0.012 * STEP
        grown += STEP
        if grown > 0.7 and not garden.is_free(tip, 0, 0.3):
            return
        garden.occupy(tip)
        points.append((tip.x, tip.y, tip.width_deg))
        until_branch -= STEP
        if until_branch < 0 and tip.width_deg > 1.5 * MIN_WIDTH_DEG:
            yield _branch(garden, tip)
            until_branch = rng.uniform(0.7, 1.5) * (1.3 + 3.0 * math.sqrt(tip.width_deg))


def _steer(garden: GrowthState, tip: Tip, grown: float) -> None:
    """Change the tip's heading by random curvature, attraction to its course, and avoidance of vessels of its kind."""
    rough = 0.14 if tip.width_deg > 0.2 else 0.22
    tip.bend += (
        -tip.bend * STEP / CURVATURE_LENGTH_DEG
        + rough * math.sqrt(2 * STEP / CURVATURE_LENGTH_DEG) * garden.rng.standard_normal()
    )
    wanted, pull = _course(tip)
    error = math.remainder(wanted - tip.heading_rad, math.tau)
    before = tip.heading_rad
    tip.heading_rad += STEP * (tip.bend + pull * error)
    if grown > 0.7 and not (garden.is_free(tip, 0, 0.6) and garden.is_free(tip, 0, 1.0)):
        left = garden.is_free(tip, -0.7, 0.7) + garden.is_free(tip, -0.5, 1.1)
        right = garden.is_free(tip, 0.7, 0.7) + garden.is_free(tip, 0.5, 1.1)
        if left != right:
            tip.heading_rad += STEP * (1.6 if right > left else -1.6)
    tip.total_turn_rad += tip.heading_rad - before if tip.arch is None else 0


def _course(tip: Tip) -> tuple[float, float]:
    """Return the target heading, rad, and the strength of attraction per degree of length."""
    if tip.arch is not None:
        u = DISC[0] - tip.x
        rise = 1 - math.exp(-max(u + 0.8, 0) / 3.2)
        height = DISC[1] + (tip.arch - DISC[1]) * rise * (1 - 0.012 * max(u - 10, 0))
        slope = -(tip.arch - DISC[1]) * math.exp(-max(u + 0.8, 0) / 3.2) / 3.2
        course = math.atan2(-slope, -1.0)
        miss = tip.y - height
        return course + math.atan(0.22 * miss), 0.55
    if tip.inward:
        return math.atan2(-tip.y, -tip.x), 0.12
    return math.atan2(tip.y - DISC[1], tip.x - DISC[0]), 0.10


def _branch(garden: GrowthState, tip: Tip) -> Tip:
    """Return the tip of a thinner branch; `tip`, which continues, is thinned and turned; w0^3 = w1^3 + w2^3."""
    rng = garden.rng
    ratio = rng.uniform(0.38, 0.62) if tip.width_deg > 0.2 else rng.uniform(0.55, 0.95)
    wide = tip.width_deg / (1 + ratio**3) ** (1 / 3)
    angle = math.radians(rng.uniform(38, 62))
    side = tip.side
    tip.side = -side if rng.random() < 0.75 else side
    heading = tip.heading_rad + side * angle
    tip.heading_rad -= side * angle * 0.35 * ratio**2
    tip.width_deg = wide
    to_fovea = math.cos(heading - math.atan2(-tip.y, -tip.x))
    return garden.number_tip(
        Tip(tip.kind, tip.x, tip.y, heading, ratio * wide, None, to_fovea > 0.25, tip.lineage, side=-side)
    )


def _tapered(points: list[tuple[float, float, float]], tip: Tip) -> NDArray[np.float32]:
    """Return the path (n, 3), with the width tapered over the last 1.2 degrees to a quarter."""
    path = np.array(points, np.float32)
    left = STEP * np.arange(len(path))[::-1]
    path[:, 2] *= np.clip(0.25 + left / 1.6, 0, 1)
    return path
