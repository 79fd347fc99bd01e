"""How retinal vessels grow: out of the disc, in arcades round the macula, branching as Murray's law says.

All places are (x, y) in degrees, right and down, with the fovea at the origin and the disc at positive x (a right eye).
Arteries never cross arteries, nor veins veins; nothing enters the avascular zone.
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
THINNEST = 0.05  # thinner vessels are not drawn
AVASCULAR = 1.15  # radius of the zone around the fovea
CELL = 0.3  # what a vessel keeps to itself
CURL = 1.7  # radians that a vessel may turn in all; the arches may turn as they must
WANDER = 1.3  # over which length a vessel forgets its bend


@dataclass(frozen=True)
class Vessel:
    """One vessel from its beginning to its end: points (n, 3) of x, y and width_deg."""

    kind: Kind
    points: NDArray[np.float32]


@dataclass(frozen=True)
class Trunk:
    """How a main vessel leaves the disc: which way (clockwise from the right), how wide, how high it arches."""

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
    """The growing end of a vessel."""

    kind: Kind
    x: float
    y: float
    heading_rad: float
    width_deg: float
    arch: float | None = None
    inward: bool = False  # towards the macula
    family: tuple[int, ...] = ()  # itself and those it came from
    bend: float = 0.0
    spun: float = 0.0  # how far it has turned since it was born
    side: int = 1


@dataclass
class Garden:
    """The ground on which the vessels of one eye grow: a circle of `reach_deg` around `centre`."""

    rng: np.random.Generator
    reach_deg: float
    centre: tuple[float, float]
    taken: dict[tuple[Kind, int, int], int] = field(default_factory=dict)
    born: int = 0

    def seed(self, tip: Tip) -> Tip:
        """Give a new tip its number."""
        tip.family = (*tip.family, self.born)
        self.born += 1
        return tip

    def take(self, tip: Tip) -> None:
        """Remember that this vessel was here first."""
        self.taken.setdefault((tip.kind, round(tip.x / CELL), round(tip.y / CELL)), tip.family[-1])

    def free(self, tip: Tip, turn_rad: float, ahead: float) -> bool:
        """Whether no strange vessel of the same kind lies ahead, if the tip turned."""
        x = tip.x + ahead * math.cos(tip.heading_rad + turn_rad)
        y = tip.y + ahead * math.sin(tip.heading_rad + turn_rad)
        owner = self.taken.get((tip.kind, round(x / CELL), round(y / CELL)))
        return owner is None or owner == tip.family[-1]

    def ends(self, tip: Tip) -> bool:
        """Whether the tip has left the ground, become too thin, curled up, or come past the fovea."""
        away = math.hypot(tip.x - self.centre[0], tip.y - self.centre[1])
        from_fovea = math.hypot(tip.x, tip.y)
        leaving = math.cos(tip.heading_rad) * tip.x + math.sin(tip.heading_rad) * tip.y > 0
        past = from_fovea < AVASCULAR or (leaving and tip.inward and from_fovea < 6)
        return away > self.reach_deg or tip.width_deg < THINNEST or past or abs(tip.spun) > CURL


def grow(seed: int, reach_deg: float, centre: tuple[float, float]) -> list[Vessel]:
    """All vessels of one eye within `reach_deg` of `centre`: the same for the same seed, the widest first."""
    garden = Garden(np.random.default_rng((seed, 1)), reach_deg, centre)
    waiting = [_sprout(garden, trunk) for trunk in TRUNKS]
    vessels = []
    while waiting:
        waiting.sort(key=lambda tip: -tip.width_deg)
        tip = waiting.pop(0)
        points = [(tip.x, tip.y, tip.width_deg)]
        for branch in _lengthen(garden, tip, points):
            waiting.append(branch)
        if len(points) > 8:
            vessels.append(Vessel(tip.kind, _tapered(points, tip)))
    return vessels


def _sprout(garden: Garden, trunk: Trunk) -> Tip:
    """A main vessel where it comes out of the cup."""
    rng = garden.rng
    heading = math.radians(trunk.heading_deg + rng.normal(0, 6))
    arch = None if trunk.arch is None else trunk.arch + rng.normal(0, 0.5)
    x, y = DISC[0] + 0.35 + 0.3 * math.cos(heading), DISC[1] + 0.5 * math.sin(heading)
    side = 1 if rng.random() < 0.5 else -1
    return garden.seed(Tip(trunk.kind, x, y, heading, trunk.width_deg * rng.uniform(0.9, 1.1), arch, side=side))


def _lengthen(garden: Garden, tip: Tip, points: list[tuple[float, float, float]]) -> Iterator[Tip]:
    """Grow one vessel to its end, writing its points and yielding its branches."""
    rng = garden.rng
    until_branch = rng.uniform(2.2, 4.0)
    grown = 0.0
    while not garden.ends(tip):
        _steer(garden, tip, grown)
        tip.x += STEP * math.cos(tip.heading_rad)
        tip.y += STEP * math.sin(tip.heading_rad)
        tip.width_deg *= 1 - 0.012 * STEP
        grown += STEP
        if grown > 0.7 and not garden.free(tip, 0, 0.3):
            return
        garden.take(tip)
        points.append((tip.x, tip.y, tip.width_deg))
        until_branch -= STEP
        if until_branch < 0 and tip.width_deg > 1.5 * THINNEST:
            yield _branch(garden, tip)
            until_branch = rng.uniform(0.7, 1.5) * (1.3 + 3.0 * math.sqrt(tip.width_deg))


def _steer(garden: Garden, tip: Tip, grown: float) -> None:
    """Turn a little: at random, towards where this vessel belongs, and away from others of its kind."""
    rough = 0.14 if tip.width_deg > 0.2 else 0.22
    tip.bend += -tip.bend * STEP / WANDER + rough * math.sqrt(2 * STEP / WANDER) * garden.rng.standard_normal()
    wanted, pull = _course(tip)
    error = math.remainder(wanted - tip.heading_rad, math.tau)
    before = tip.heading_rad
    tip.heading_rad += STEP * (tip.bend + pull * error)
    if grown > 0.7 and not (garden.free(tip, 0, 0.6) and garden.free(tip, 0, 1.0)):
        left = garden.free(tip, -0.7, 0.7) + garden.free(tip, -0.5, 1.1)
        right = garden.free(tip, 0.7, 0.7) + garden.free(tip, 0.5, 1.1)
        if left != right:
            tip.heading_rad += STEP * (1.6 if right > left else -1.6)
    tip.spun += tip.heading_rad - before if tip.arch is None else 0


def _course(tip: Tip) -> tuple[float, float]:
    """Where a vessel here wants to go, in rad, and how strongly, per degree of length."""
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


def _branch(garden: Garden, tip: Tip) -> Tip:
    """Split: the thinner daughter leaves at a wide angle, the thicker one goes on; w0^3 = w1^3 + w2^3 (Murray 1926)."""
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
    return garden.seed(
        Tip(tip.kind, tip.x, tip.y, heading, ratio * wide, None, to_fovea > 0.25, tip.family, side=-side)
    )


def _tapered(points: list[tuple[float, float, float]], tip: Tip) -> NDArray[np.float32]:
    """The path, with the last degree thinned where the vessel ends inside the eye."""
    path = np.array(points, np.float32)
    left = STEP * np.arange(len(path))[::-1]
    path[:, 2] *= np.clip(0.25 + left / 1.6, 0, 1)
    return path
