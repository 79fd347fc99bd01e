"""Search over LEDs, ring, iris, exposure and frames for heads that give a human eye enough light within the limits."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product as combinations
from math import exp

from device.config.head_file import ChainSpec
from device.light_safety.hazard import Limits, light_limits
from device.optics.budget import Design
from device.optics.eye import reflex_free_mm
from device.optics.illumination import LED, Led, led_at
from device.optics.light_budget import CELL_UM, ENOUGH_E, chain, log_sd, product
from device.values import Colour
from services.workshop.light_report import GUARD, expected_beam, half_period_um, limit_shares, permitted_level
from services.workshop.optics_report import widest_iris_mm

BELOW = 1.645  # standard deviations above the 5 % quantile of a log-normal product
SUPPLY_MA = 500.0  # below the least limit of the load switch, TPS2553 with 43.2 kOhm: 544 mA


@dataclass(frozen=True)
class LedChoice:
    """One LED with its drive: colour, LED at that current, current of one LED, width of what shines."""

    name: str
    colour: Colour
    led: Led
    current_ma: float
    emitter_mm: float


# Powers are estimates within a factor of two. "1 mm die" stands for undomed 1 W LEDs behind TLC5971 outputs of 60 mA,
# one to three in parallel; up to 120 mA the green one is in proportion to the current, as the head file has it.
CHOICES = (
    LedChoice("APA102, 10 mA", "green", LED["green"], 10, 0.25),
    LedChoice("1 mm die, 60 mA", "green", led_at(0.525, 30), 60, 1.0),
    LedChoice("1 mm die, 120 mA", "green", led_at(0.525, 60), 120, 1.0),
    LedChoice("1 mm die, 180 mA", "green", led_at(0.525, 84), 180, 1.0),
    LedChoice("1 mm die, 60 mA", "amber", led_at(0.590, 15), 60, 1.0),
    LedChoice("1 mm die, 120 mA", "amber", led_at(0.590, 28), 120, 1.0),
)
COUNTS = (4, 6, 8, 12)
RINGS_MM = (8.6, 9.2, 10.04)
IRISES_UM = (2400.0, 3200.0, 4000.0)
EXPOSURES_S = (0.05, 0.1, 0.2)
FRAMES = (1, 2, 4)


@dataclass(frozen=True)
class Candidate:
    """One head of the search with its light at the drive `level` (0 to 1) that the limits permit of a measured ring.

    `light_e`: electrons in a cell of CELL_UM, `low_e` its 5 % quantile over builds. `half_period_um`: resolved on the
    retina. `limit`: the light limit of which most is used, and `largest_share` how much of it, 0 to 1.
    """

    choice: LedChoice
    leds: int
    ring_mm: float
    iris_um: float
    exposure_s: float
    frames: int
    level: float
    light_e: float
    low_e: float
    half_period_um: float
    largest_share: float
    limit: str

    @property
    def lit_s(self) -> float:
        """Seconds of light of one picture."""
        return self.exposure_s * self.frames


def search(base: Design) -> list[Candidate]:
    """Return all candidates of the grid around a design, those with enough light first, then by seconds of light.

    Left out: rings whose current the supply does not give, whose image does not clear the cornea's reflex, or does not
    fit into the pupil to more than a half; irises wider than the pupil's margin permits, or whose caustic is too wide
    for the sensor to be calibrated.
    """
    limits = light_limits()
    found = [candidate for candidate in _candidates(base, limits) if candidate is not None]
    return sorted(found, key=lambda candidate: (candidate.light_e < ENOUGH_E, candidate.lit_s, -candidate.light_e))


def _candidates(base: Design, limits: Limits) -> Iterator[Candidate | None]:
    for choice, leds, ring_mm, iris_um in combinations(CHOICES, COUNTS, RINGS_MM, IRISES_UM):
        if leds * choice.current_ma > SUPPLY_MA:
            continue
        for exposure_s, frames in combinations(EXPOSURES_S, FRAMES):
            yield _candidate(base, choice, leds, ring_mm, iris_um, exposure_s, frames, limits)


def _candidate(
    base: Design,
    choice: LedChoice,
    leds: int,
    ring_mm: float,
    iris_um: float,
    exposure_s: float,
    frames: int,
    limits: Limits,
) -> Candidate | None:
    around = ChainSpec(rows=1, cols=1, pitch_mm=1, axis=(0, -ring_mm / 2), leds=(0,))  # one LED stands for the ring
    design = replace(
        base,
        radiometry=None,
        chain=around,
        colour=choice.colour,
        led=choice.led,
        emitter_mm=choice.emitter_mm,
        exposure_s=exposure_s,
        optics=base.optics.model_copy(update={"iris_um": iris_um}),
    )
    if iris_um / 1000 > widest_iris_mm(base):
        return None
    inner_mm = design.relay.angular_magnification * (ring_mm - choice.emitter_mm) / 2
    if inner_mm <= reflex_free_mm(design.optics.field_deg / 2) or design.relay.pupil_margin_mm(design.pupil_mm) < 0:
        return None
    whole = replace(design, led=replace(choice.led, power_mw=leds * choice.led.power_mw))
    led_beam = expected_beam(design)
    all_of_them = expected_beam(whole)
    shares = limit_shares(design, replace(all_of_them, waist_w_per_cm2=led_beam.waist_w_per_cm2), limits)
    level = permitted_level(shares)
    factors = chain(whole, level, frames)
    if whole.share_in_pupil <= 0.5:
        return None
    electrons = product(factors)
    worst = max(shares, key=lambda share: share.used)
    return Candidate(
        choice,
        leds,
        ring_mm,
        iris_um,
        exposure_s,
        frames,
        level,
        electrons,
        electrons * exp(-BELOW * log_sd(factors)),
        half_period_um(design, electrons),
        worst.used * level,
        worst.name,
    )


def table(base: Design, most: int = 25) -> str:
    """Return the best candidates as text, one line each, and the best of each kind of LED."""
    found = search(base)
    enough = [candidate for candidate in found if candidate.light_e >= ENOUGH_E]
    lines = [
        f"{len(found)} heads, {len(enough)} of them with at least {ENOUGH_E:g} electrons in a cell of {CELL_UM:g} um; "
        f"measured ring, guard factor {GUARD:g}",
        "another iris than the head's is another print, another ring another LED cap and board",
        f"{'LED':<17}{'colour':<7}{'n':>3}{'ring':>7}{'iris':>6}{'ms':>5}{'x':>3}{'drive':>7}{'electrons':>10}"
        f"{'5 %':>8}{'um':>5}  most used limit",
    ]
    best = {(candidate.choice.name, candidate.choice.colour): candidate for candidate in reversed(found)}
    return "\n".join([*lines, *map(_line, found[:most]), "best of each LED:", *map(_line, best.values())])


def _line(candidate: Candidate) -> str:
    return (
        f"{candidate.choice.name:<17}{candidate.choice.colour:<7}{candidate.leds:>3}{candidate.ring_mm:>7.2f}"
        f"{candidate.iris_um / 1000:>6.1f}{1000 * candidate.exposure_s:>5.0f}{candidate.frames:>3}"
        f"{candidate.level:>7.2f}{candidate.light_e:>10.0f}{candidate.low_e:>8.0f}"
        f"{candidate.half_period_um:>5.0f}  {candidate.limit} {candidate.largest_share:.0%}"
    )
