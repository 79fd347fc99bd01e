"""Full angle of the field that a head lights, and whether its edge is sharp (OPTICS.md 4.9).

It is wider than the cone of its cap where the dies of its LEDs are no points. Only a constant-current ring states the
width of its dies; the matrix's are small, and its field keeps a sharp edge.
"""

from functools import cache
from math import acos, pi

from device.config.head_file import InstrumentSpec
from device.config.shipped_heads import LIGHT_PATH
from device.optics.led_cap import LedCap, field_to_share_deg, half_maximum_deg
from device.optics.light_path import LightPath, led_cap, load_light_path
from device.optics.matrix import lamps_of
from device.values import Colour

EDGE_SHARE = 0.03  # of the axis's irradiance, at the edge of a picture's field: 0.5 % of the light is beyond
RAMP_SHARE = 0.1  # of it, through which the cosine ramp passes


def cap_of(spec: InstrumentSpec, colour: Colour | None = None) -> LedCap | None:
    """Return the hole before each LED of a head in `colour`, by default the picture's; None without dies of a width."""
    lamp = (lamps_of(spec) or {}).get(colour or spec.light.colour)
    if spec.light.sinks is None or spec.optics is None or lamp is None:
        return None
    return led_cap(_light_path(), spec.optics, lamp.emitter_mm)


def picture_field_deg(spec: InstrumentSpec) -> float | None:
    """Return the full angle of the field from which light has to be reconstructed, degrees; None without [optics]."""
    cap = cap_of(spec)
    if spec.optics is None or cap is None:
        return None if spec.optics is None else spec.optics.field_deg
    return max(spec.optics.field_deg, field_to_share_deg(cap, spec.optics.angular_magnification, EDGE_SHARE))


def soft_edge_deg(spec: InstrumentSpec) -> tuple[float, float] | None:
    """Return diameter and full width in degrees of the cosine ramp by which the light of a head fades; None: sharp.

    It passes through half of the axis's irradiance, at that diameter, and through RAMP_SHARE of it.
    """
    cap = cap_of(spec)
    if spec.optics is None or cap is None:
        return None
    magnification = spec.optics.angular_magnification
    half_deg = half_maximum_deg(cap, magnification)
    outward_deg = (field_to_share_deg(cap, magnification, RAMP_SHARE) - half_deg) / 2
    return half_deg, outward_deg / (0.5 - acos(1 - 2 * RAMP_SHARE) / pi)


def has_sharp_edge(spec: InstrumentSpec) -> bool:
    """Return whether the field of a head ends within a degree, so that its place and size can be read from a frame."""
    return cap_of(spec) is None


@cache
def _light_path() -> LightPath:
    return load_light_path(LIGHT_PATH)
