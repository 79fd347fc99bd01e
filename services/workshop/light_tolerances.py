"""Tolerances of a head's light: what each does to the share of the photochemical limit, and to the field's edge."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import exp, hypot, log

from device.config.radiometry import LED_FWHM_UM
from device.light_safety.hazard import LED_POWER_UNCERTAINTY, Limits
from device.optics.budget import Design
from device.optics.led_cap import LedCap, centre_over_mean, half_maximum_deg, seen_share

HOLE_MM, HEIGHT_MM, BESIDE_MM = 0.1, 0.3, 0.2  # of a printed cap and soldered LEDs (estimates)
DIE_SHARE = 0.1  # of its width (an estimate)
LENS_SHARE = 0.01  # of the focal length of a pair (OPTICS.md 6.3)
BIN_UM = 0.0075  # of the wavelength, half of a bin of 15 nm
Ends = tuple[float, float]


@dataclass(frozen=True)
class Tolerance:
    """One tolerance with its size as text, and the head at its worst ends.

    `used` is the share of the photochemical limit with it. `half_deg` is the field to half of the axis's irradiance,
    `centre` the irradiance of the axis over the whole light spread evenly over the head's field: what a reading of the
    whole light would miss.
    """

    name: str
    size: str
    used: float
    half_deg: Ends
    centre: Ends


def tolerances(design: Design, used: float, limits: Limits) -> tuple[Tolerance, ...]:
    """Return the drawn head, each tolerance, and all together, for a ring that uses the share `used` as drawn.

    Together: the logarithms of the irradiances by the root of their summed squares, and the extreme fields. A measured
    ring has no tolerance of power and wavelength.
    """
    cap = design.cap
    a = design.relay.angular_magnification
    um = design.led.wavelength_um
    holes, heights, dies = (
        [replace(cap, **{key: getattr(cap, key) + way * slack}) for way in (-1, 1)]
        for key, slack in (("hole_mm", HOLE_MM), ("height_mm", HEIGHT_MM), ("emitter_mm", DIE_SHARE * cap.emitter_mm))
    )
    relays = [a * (1 + way * LENS_SHARE) / (1 - way * LENS_SHARE) for way in (-1, 1)]
    beside = float(seen_share(cap, BESIDE_MM / cap.height_mm, BESIDE_MM / cap.height_mm))
    rows: list[tuple[str, str, float, Sequence[LedCap], Sequence[float], float]] = [
        ("hole of the cap", f"{HOLE_MM:g} mm", 1.0, holes, [a], 1.0),
        ("end of the hole from the LED", f"{HEIGHT_MM:g} mm", 1.0, heights, [a], 1.0),
        ("width of the die", f"{DIE_SHARE:.0%}", 1.0, dies, [a], 1.0),
        ("LED beside its hole", f"{BESIDE_MM:g} mm", 1.0, [cap], [a], beside),
        ("focal length of a lens pair", f"{LENS_SHARE:.0%}", (relays[1] / a) ** 2, [cap], relays, 1.0),
    ]
    if design.measured is None:
        weight = limits.photochemical_weight.of_spectrum
        bluer = weight(um - BIN_UM, LED_FWHM_UM) / weight(um, LED_FWHM_UM)
        rows.append(("power of an LED", f"x {LED_POWER_UNCERTAINTY:g}", LED_POWER_UNCERTAINTY, [cap], [a], 1.0))
        rows.append(("wavelength in its bin", f"{1000 * BIN_UM:g} nm", bluer, [cap], [a], 1.0))
    worst = exp(hypot(*(log(row[2]) for row in rows)))
    caps = [
        LedCap(hole.hole_mm, height.height_mm, die.emitter_mm) for hole, height, die in product(holes, heights, dies)
    ]
    rows = [("as drawn", "", 1.0, [cap], [a], 1.0), *rows, ("together", "", worst, caps, relays, beside)]
    return tuple(
        Tolerance(name, size, used * times, *_ends(some, relay, seen, design.optics.field_deg))
        for name, size, times, some, relay, seen in rows
    )


def _ends(caps: Sequence[LedCap], relays: Sequence[float], seen: float, field_deg: float) -> tuple[Ends, Ends]:
    """Return the least and largest field to half, and centre over mean, of caps before relays; `seen`: of the die."""
    halves = [half_maximum_deg(cap, a) for cap in caps for a in relays]
    centres = [centre_over_mean(cap, a, field_deg) for cap in caps for a in relays]
    return (min(halves), max(halves)), (seen * min(centres), max(centres))


def table(found: tuple[Tolerance, ...]) -> list[str]:
    """Return the tolerances as lines of text."""
    lines = [f"{'tolerance':<30}{'size':>8}{'of the limit':>14}{'half at, deg':>16}{'axis over mean':>16}"]
    return lines + [
        f"{tolerance.name:<30}{tolerance.size:>8}{tolerance.used:>13.0%} {_between(tolerance.half_deg, 1):>16}"
        f"{_between(tolerance.centre, 2):>16}"
        for tolerance in found
    ]


def _between(ends: Ends, digits: int) -> str:
    low, high = (f"{end:.{digits}f}" for end in ends)
    return low if low == high else f"{low} to {high}"
