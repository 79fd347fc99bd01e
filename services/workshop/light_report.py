"""Light budget of a head as text and plot: the chain of factors, what limits it, and the limits of light at an eye.

The limits are judged for the worst eye, whose pupil passes the light of the whole ring, as `diffuscope light` judges a
meter's reading; the electrons are those that the design's pupil lets in.
"""

from dataclasses import dataclass, replace
from math import floor, log10, pi, radians

import numpy as np

from device.config.radiometry import LED_FWHM_UM, WAIST_CM2
from device.errors import SettingError
from device.light_safety.hazard import Beam, Hazard, Limits, light_limits, worst_beam
from device.optics.budget import Design
from device.optics.illumination import MEAN_OVER_PEAK, half_period_deg, within_simulated_range
from device.optics.led_cap import relative_irradiance
from device.optics.light_budget import (
    CELL_UM,
    CONE,
    DRAWS,
    ENOUGH_E,
    Factor,
    Spread,
    chain,
    cornea_mw,
    possible_gains,
    product,
    simulated,
    to_cornea,
)
from device.optics.matrix import inner_ring_at_pupil_mm, ring
from device.values import Illumination
from services.plot import document, line, rectangle, text
from services.workshop import light_tolerances

GUARD = 1.3  # factor of a measured ring, the least that a head file may have
REFERENCE_CELL_UM = 5.04
SMALL_PUPIL_MM = 7.0  # beside that of the design: what dilates less
AXIS_HOLE_MM, AXIS_DISTANCE_MM = 5.0, 100.0  # hole before a power meter, on the axis, so far behind the pupil
EDGE_DEG = (10.0, 14.0, 16.7, 20.0)  # off the axis
AXIS_HOLE_SR = pi * (AXIS_HOLE_MM / 2 / AXIS_DISTANCE_MM) ** 2
WEIGHT_SPREAD = 0.2  # of ln A(lambda) over a bin of 15 nm of green LEDs, by the slope of ln 10 / 50 nm


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


@dataclass(frozen=True)
class FullDrive:
    """Builds of a design at full drive by Monte Carlo: photochemical share of the limit, and which exceed it.

    `no_go`: share of the builds above the limit, 0 to 1. `electrons`: in a cell of 10 um, where such a build has its
    current lowered to the limit.
    """

    share: Spread
    no_go: float
    electrons: Spread


def expected_uw(design: Design) -> float:
    """Return the power that the light budget expects behind the hole on the axis at full drive, uW."""
    return 1000 * design.axis_mw_per_sr * AXIS_HOLE_SR


def expected_beam(design: Design) -> Beam:
    """Return the beam in an eye whose pupil takes in the whole ring, times the guard factor of its measurement.

    Without a measurement: that of the light budget, times GUARD.
    """
    table = design.radiometry
    measured = design.measured
    if table is not None and measured is not None:
        scale = table.guard_factor / 1000
        retina = measured.retina_mw_per_cm2
        waist = measured.waist_mw_per_cm2
        return Beam(measured.wavelength_um, scale * retina, scale * waist, measured.fwhm_um)
    scale = GUARD / 1000
    waist = cornea_mw(chain(design)) / len(ring(design.chain)) / WAIST_CM2
    return Beam(design.led.wavelength_um, scale * design.highest_mw_per_cm2, scale * waist, LED_FWHM_UM)


def at_full_drive(design: Design, frames: int = 1) -> FullDrive:
    """Return what builds of a design give at full drive, each factor of the chain log-normal and drawn once a build.

    The share has those of the chain up to the cornea without the cone, which the intensity on the axis does not depend
    on, and of an unmeasured ring the wavelength's within a bin.
    """
    factors = chain(design, frames=frames)
    rng = np.random.default_rng(0)
    bright = [i for i, factor in enumerate(to_cornea(factors)) if factor.name != CONE]
    spreads = np.array([factor.spread for factor in factors])
    logs = rng.standard_normal((DRAWS, len(factors))) * spreads
    weight = 0.0 if design.measured else WEIGHT_SPREAD
    bins = weight * rng.standard_normal(DRAWS)
    used = limit_shares(design, expected_beam(design), light_limits())[0].used
    share = used * np.exp(logs[:, bright].sum(axis=1) + bins)
    electrons = product(factors) * np.exp(logs.sum(axis=1)) * np.minimum(1, 1 / share)
    (low, half, high), (low_e, half_e, high_e) = (np.quantile(draws, (0.05, 0.5, 0.95)) for draws in (share, electrons))
    return FullDrive(
        Spread(float(half), float(low), float(high)),
        float((share > 1).mean()),
        Spread(float(half_e), float(low_e), float(high_e)),
    )


def refuse_dark(design: Design) -> None:
    """Raise SettingError for a design whose pupil passes no light of the ring: it has no budget."""
    if design.share_in_pupil > 0:
        return
    magnification = design.relay.angular_magnification
    begins_mm = inner_ring_at_pupil_mm(design.chain, magnification) - magnification * design.emitter_mm
    raise SettingError(
        f"no light reaches the sensor: a pupil of {design.pupil_mm:g} mm passes nothing of this ring, whose image at "
        f"the eye begins at a diameter of {begins_mm:.2f} mm",
        f"Give a pupil wider than {begins_mm:.2f} mm (--pupil-mm), or a head with a narrower ring.",
    )


def unmeasured_beam(design: Design) -> Beam:
    """Return the beam that the guard assumes of this ring until its light has been measured."""
    return worst_beam(design.colour, design.optics.field_deg, len(ring(design.chain)), design.led)


def limit_shares(design: Design, beam: Beam, limits: Limits) -> tuple[LimitShare, ...]:
    """Return the three irradiance limits with what a beam gives at full drive."""
    hazard = Hazard({design.colour: beam}, limits)
    full = Illumination(design.colour)
    return (
        LimitShare(
            "photochemical", 1e6 * hazard.photochemical_w_per_cm2(full), 1e6 * limits.photochemical_w_per_cm2, "uW/cm2"
        ),
        LimitShare("thermal", 1e3 * hazard.thermal_w_per_cm2(full), 1e3 * limits.thermal_w_per_cm2, "mW/cm2"),
        LimitShare("waist", 1e3 * hazard.waist_w_per_cm2(full), 1e3 * limits.waist_w_per_cm2, "mW/cm2"),
    )


def permitted_level(shares: tuple[LimitShare, ...]) -> float:
    """Return the largest drive that no limit refuses, 0 to 1, rounded down to a thousandth."""
    return floor(1000 * min(1.0, 1 / max(share.used for share in shares))) / 1000


def half_period_um(design: Design, electrons_per_cell: float) -> float:
    """Return the expected half-period on the retina, um, of a picture with that light (OPTICS.md 4.3)."""
    return radians(half_period_deg(_peak_e(electrons_per_cell), REFERENCE_CELL_UM)) * design.eye_mm * 1000


def _peak_e(electrons_per_cell: float) -> float:
    """Return the electrons of the brightest pixel of REFERENCE_CELL_UM by the mean in a cell of 10 um."""
    return electrons_per_cell * (REFERENCE_CELL_UM / CELL_UM) ** 2 / MEAN_OVER_PEAK


def table(design: Design, frames: int = 1) -> str:
    """Return chain, uncertainty, limits, permitted drive and gains of a design as text; errors as `refuse_dark`."""
    refuse_dark(design)
    factors = chain(design, frames=frames)
    limits = light_limits()
    return "\n".join(
        [
            f"{design.title}: {design.colour}, {frames} frame(s) of {1000 * design.exposure_s:g} ms, "
            f"electrons in a cell of {CELL_UM:g} um",
            *_chain_lines(design, factors, frames),
            "",
            *_limit_lines(design, limits, frames),
            *_build_lines(design, frames),
            "",
            *_edge_lines(design, limits),
            "",
            *_gain_lines(factors),
        ]
    )


def _chain_lines(design: Design, factors: tuple[Factor, ...], frames: int) -> list[str]:
    lines = [f"{'factor':<26}{'value':>10} {'unit':<5}{'sd of ln':>8}  {'belongs to':<11}source"]
    lines += [
        f"{factor.name:<26}{factor.value:>10.4g} {factor.unit:<5}{factor.spread:>8.2f}  "
        f"{factor.cause:<11}{factor.source}"
        for factor in factors
    ]
    spread = simulated(factors)
    small = product(chain(replace(design, pupil_mm=SMALL_PUPIL_MM), frames=frames))
    return [
        *lines,
        f"{'product':<26}{product(factors):>10.0f} e-   90 % of draws: {spread.low:.0f} to {spread.high:.0f}, with a "
        f"pupil of {design.pupil_mm:g} mm; with one of {SMALL_PUPIL_MM:g} mm {small:.0f}",
    ]


def _limit_lines(design: Design, limits: Limits, frames: int) -> list[str]:
    found = "as expected, x 1.3" if design.radiometry is None or design.measured is None else "as measured"
    lines = [f"{'limit, standard x share':<26}{'limit':>12} {'unmeasured ring':>22} {found:>22}   all light enters"]
    beams = (unmeasured_beam(design), expected_beam(design))
    both = [limit_shares(design, beam, limits) for beam in beams]
    for worst, expected in zip(*both, strict=True):
        values = "".join(f" {f'{share.value:.3g} = {100 * share.used:.3g} %':>22}" for share in (worst, expected))
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
        "electrons in a cell": [f"{count:.0f}" for count in electrons],
        "half-period, um": [_half_period(design, count) for count in electrons],
        f"enough ({ENOUGH_E:g} e-)": ["yes" if count >= ENOUGH_E else "no" for count in electrons],
    }
    return [*lines, *(f"{name:<39} {first:>22} {second:>22}" for name, (first, second) in rows.items())]


def _half_period(design: Design, electrons: float) -> str:
    """Return the half-period, with a mark where no simulation supports it."""
    known = within_simulated_range(_peak_e(electrons), REFERENCE_CELL_UM)
    return f"{'' if known else 'not simulated: '}{half_period_um(design, electrons):.0f}"


def _build_lines(design: Design, frames: int) -> list[str]:
    found = at_full_drive(design, frames)
    share = found.share
    electrons = found.electrons
    return [
        f"photochemical limit at full drive, as expected: 90 % of builds use {100 * share.low:.0f} to "
        f"{100 * share.high:.0f} %, {100 * found.no_go:.0f} % of builds are NO GO",
        "  such a build needs less current, of a constant-current ring by another resistor; all within the limit:",
        f"  median {electrons.median:.0f} electrons, 90 % {electrons.low:.0f} to {electrons.high:.0f}, half-period "
        f"{_half_period(design, electrons.median)} um",
    ]


def _edge_lines(design: Design, limits: Limits) -> list[str]:
    """Return how the light falls towards the field's edge, and the tolerances."""
    cap = design.cap
    magnification = design.relay.angular_magnification
    shares = relative_irradiance(cap, magnification, EDGE_DEG)
    used = limit_shares(design, expected_beam(design), limits)[0].used
    return [
        "the limits count the highest irradiance of a retina, that of the axis: "
        f"{design.highest_mw_per_cm2:.3g} mW/cm2 by {design.axis_mw_per_sr:.3g} mW/sr;",
        "of it "
        + ", ".join(f"{share:.2f} at {deg:g} deg" for share, deg in zip(shares, EDGE_DEG, strict=True))
        + f" off the axis: a die of {cap.emitter_mm:g} mm shines through a hole of {cap.hole_mm:g} mm that ends "
        f"{cap.height_mm:.2f} mm before it",
        *light_tolerances.table(light_tolerances.tolerances(design, used, limits)),
    ]


def _gain_lines(factors: tuple[Factor, ...]) -> list[str]:
    lines = ["what limits it: times more light if this were ideal"]
    return [*lines, *(f"  {cause:<12}{gain:>7.1f}" for cause, gain in possible_gains(factors).items())]


WIDE, BAR, LEFT = 640, 26, 130


def gains_svg(design: Design, frames: int = 1) -> str:
    """Return bars, logarithmic from 1 to 100, of the possible gains of light by cause, and the light itself, as SVG.

    Errors as `refuse_dark`.
    """
    refuse_dark(design)
    factors = chain(design, frames=frames)
    gains = {cause: gain for cause, gain in possible_gains(factors).items() if gain > 1}
    spread = simulated(factors)
    scale = (WIDE - LEFT - 70) / log10(100)
    y = 92.0
    light = f"{spread.median:.0f} electrons in a cell of 10 um, 90 % between {spread.low:.0f} and {spread.high:.0f}"
    parts = [
        text(16, 28, "Times more light if this were ideal", "title"),
        text(16, 48, design.title, "small quiet"),
        text(16, 64, light, "small quiet"),
    ]
    for cause, gain in gains.items():
        long = max(1.0, scale * log10(min(gain, 100.0)))
        parts.append(text(LEFT - 8, y + 5, cause, "small", "end"))
        parts.append(rectangle(LEFT, y - 8, long, 16, "mark s1"))
        parts.append(text(LEFT + long + 8, y + 5, f"x {gain:.1f}", "small"))
        y += BAR
    parts.append(line(LEFT, 78, LEFT, y - 10, "frame"))
    return document(WIDE, y, "Possible gains of light by cause", f"{design.title}: {light}", parts)
