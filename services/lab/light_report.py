"""Light budget of a head as text and plot: the chain of factors, what limits it, and the limits of light at an eye."""

from dataclasses import dataclass
from math import floor, log10, pi, radians, tan

from device.config.radiometry import WAIST_CM2
from device.light_safety.hazard import Beam, Hazard, Limits, light_limits, worst_beam
from device.optics.budget import Design
from device.optics.illumination import half_period_deg
from device.optics.light_budget import (
    CELL_UM,
    ENOUGH_E,
    Factor,
    chain,
    possible_gains,
    product,
    retina_mw_per_cm2,
    simulated,
)
from device.optics.matrix import ring
from device.values import Illumination
from services.lab.plot import STYLE, line, text

GUARD = 1.3  # factor of a measured ring, the least that a head file may have
REFERENCE_CELL_UM = 5.04


@dataclass(frozen=True)
class LimitShare:
    """One limit of light: what full drive gives, and this instrument's limit (standard times share), same unit."""

    name: str
    value: float
    limit: float
    unit: str

    @property
    def used(self) -> float:
        """Share of the limit that full drive uses; above 1 the drive must be lowered."""
        return self.value / self.limit


def expected_beam(design: Design) -> Beam:
    """Return the beam that the budget expects, times the guard factor of a measured ring."""
    factors = chain(design)
    names = [factor.name for factor in factors]
    cornea_mw = product(factors[: names.index("lit retina")]) / len(ring(design.chain))
    return Beam(
        design.led.wavelength_um, GUARD * retina_mw_per_cm2(factors) / 1000, GUARD * cornea_mw / WAIST_CM2 / 1000
    )


def unmeasured_beam(design: Design) -> Beam:
    """Return the beam that the guard assumes of this ring until its light has been measured."""
    return worst_beam(design.colour, design.optics.field_deg, len(ring(design.chain)), design.led)


def limit_shares(design: Design, beam: Beam, limits: Limits) -> tuple[LimitShare, ...]:
    """Return the three irradiance limits with what a beam gives at full drive."""
    hazard, full = Hazard({design.colour: beam}, limits), Illumination(design.colour)
    return (
        LimitShare("photochemical", 1e6 * hazard.photochemical_w_per_cm2(full),
                   1e6 * limits.photochemical_w_per_cm2, "uW/cm2"),
        LimitShare("thermal", 1e3 * hazard.thermal_w_per_cm2(full), 1e3 * limits.thermal_w_per_cm2, "mW/cm2"),
        LimitShare("waist", 1e3 * hazard.waist_w_per_cm2(full), 1e3 * limits.waist_w_per_cm2, "mW/cm2"),
    )  # fmt: skip


def permitted_level(shares: tuple[LimitShare, ...]) -> float:
    """Return the largest drive that no limit refuses, 0 to 1, rounded down to a thousandth."""
    return floor(1000 * min(1.0, 1 / max(share.used for share in shares))) / 1000


def half_period_um(design: Design, electrons_per_cell: float) -> float:
    """Return the expected half-period on the retina, um, of a picture with that light (OPTICS.md 4.3)."""
    electrons = electrons_per_cell * (REFERENCE_CELL_UM / CELL_UM) ** 2
    return radians(half_period_deg(electrons, REFERENCE_CELL_UM)) * design.eye_mm * 1000


def table(design: Design, frames: int = 1) -> str:
    """Return chain, uncertainty, limits, permitted drive and gains of a design as text."""
    factors, limits = chain(design, frames=frames), light_limits()
    return "\n".join([
        f"{design.title}: {design.colour}, {frames} frame(s) of {1000 * design.exposure_s:g} ms, "
        f"electrons in a cell of {CELL_UM:g} um",
        *_chain_lines(factors), "", *_limit_lines(design, limits, frames), "", *_gain_lines(factors),
    ])  # fmt: skip


def _chain_lines(factors: tuple[Factor, ...]) -> list[str]:
    lines = [f"{'factor':<26}{'value':>10} {'unit':<5}{'sd of ln':>8}  {'belongs to':<11}source"]
    lines += [
        f"{one.name:<26}{one.value:>10.4g} {one.unit:<5}{one.spread:>8.2f}  {one.cause:<11}{one.source}"
        for one in factors
    ]
    spread = simulated(factors)
    return [
        *lines,
        f"{'product':<26}{product(factors):>10.0f} e-   90 % of draws: {spread.low:.0f} to {spread.high:.0f}",
    ]


def _limit_lines(design: Design, limits: Limits, frames: int) -> list[str]:
    lines = [f"{'limit, standard x share':<26}{'limit':>12} {'unmeasured ring':>22} {'as expected, x 1.3':>22}"]
    beams = (unmeasured_beam(design), expected_beam(design))
    both = [limit_shares(design, beam, limits) for beam in beams]
    for worst, expected in zip(*both, strict=True):
        values = "".join(f" {f'{one.value:.3g} = {100 * one.used:.3g} %':>22}" for one in (worst, expected))
        lines.append(f"{worst.name:<26}{worst.limit:>5.4g} {worst.unit:>6}{values}")
    levels = [permitted_level(shares) for shares in both]
    doses = [
        1e-6 * shares[0].value * level * frames * design.exposure_s for shares, level in zip(both, levels, strict=True)
    ]
    electrons = [product(chain(design, level, frames)) for level in levels]
    stop = limits.stop_j_per_cm2
    rows = {
        "permitted drive": [f"{level:.3g}" for level in levels],
        "dose of a picture, J/cm2": [f"{dose:.2g} = {100 * dose / stop:.2g} %" for dose in doses],
        "electrons in a cell": [f"{one:.0f}" for one in electrons],
        "half-period, um": [f"{half_period_um(design, one):.0f}" for one in electrons],
        f"enough ({ENOUGH_E:g} e-)": ["yes" if one >= ENOUGH_E else "no" for one in electrons],
    }
    return [*lines, *(f"{name:<39} {first:>22} {second:>22}" for name, (first, second) in rows.items())]


def _gain_lines(factors: tuple[Factor, ...]) -> list[str]:
    lines = ["what limits it: times more light if this were ideal"]
    return [*lines, *(f"  {cause:<12}{gain:>7.1f}" for cause, gain in possible_gains(factors).items())]


WIDE, BAR, LEFT = 640, 26, 130


def gains_svg(design: Design, frames: int = 1) -> str:
    """Return bars, logarithmic from 1 to 100, of the possible gains of light by cause, and the light itself, as SVG."""
    factors = chain(design, frames=frames)
    gains = {cause: gain for cause, gain in possible_gains(factors).items() if gain > 1}
    spread, scale, y = simulated(factors), (WIDE - LEFT - 70) / log10(100), 92.0
    light = f"{spread.median:.0f} electrons in a cell of 10 um, 90 % between {spread.low:.0f} and {spread.high:.0f}"
    parts = [text(16, 28, "Times more light if this were ideal", "title"), text(16, 48, design.title, "small quiet"),
             text(16, 64, light, "small quiet")]  # fmt: skip
    for cause, gain in gains.items():
        long = max(1.0, scale * log10(min(gain, 100.0)))
        parts.append(text(LEFT - 8, y + 5, cause, "small", "end"))
        parts.append(f'<rect class="mark s1" x="{LEFT}" y="{y - 8:.1f}" width="{long:.1f}" height="16"/>')
        parts.append(text(LEFT + long + 8, y + 5, f"x {gain:.1f}", "small"))
        y += BAR
    parts.append(line(LEFT, 78, LEFT, y - 10, "frame"))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDE} {y:.0f}" role="img" '
        f'aria-label="Possible gains of light by cause"><style>{STYLE}</style>'
        f'<rect class="ground" width="{WIDE}" height="{y:.0f}"/>{"".join(parts)}</svg>\n'
    )


def lit_area_cm2(field_deg: float, eye_mm: float = 17.0) -> float:
    """Return the lit area of a retina, cm2, for a full field angle: the chain's factor `lit retina`, inverted."""
    return pi * (eye_mm / 10 * tan(radians(field_deg / 2))) ** 2
