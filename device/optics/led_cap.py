"""Light of an LED through its hole in the cap: intensity on the axis, and how it falls towards the field's edge.

Each LED shines through a hole `hole_mm` wide that ends `height_mm` before its die. A direction sees the part of the die
that the hole leaves free, so a die that is not a point has a penumbra (OPTICS.md 4.9). On the axis the whole die is
seen: hole, height and die do not change the intensity there, from which the highest irradiance of a retina follows.
"""

from dataclasses import dataclass
from math import pi, radians, tan

import numpy as np
from numpy.typing import ArrayLike, NDArray

_STRIPS = 48  # of the die, across the direction of its rows: the share is then within 0.001
_TURNS_DEG = np.arange(2.5, 45, 5.0)  # azimuths of a mean over all, by the square's symmetry
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LedCap:
    """Hole before an LED: its width, the distance of its end from the die, and the side of the square die, mm."""

    hole_mm: float
    height_mm: float
    emitter_mm: float


def cap_height_mm(hole_mm: float, half_cone_deg: float) -> float:
    """Return how far before an LED a hole of that width ends, so that the die's middle shines into this half cone."""
    return hole_mm / 2 / tan(radians(half_cone_deg))


def seen_share(cap: LedCap, right: ArrayLike, up: ArrayLike) -> Floats:
    """Return the share of the die, 0 to 1, that is seen under slopes of a ray at the LED (tangents, right and up).

    The shape is that of the slopes together. Rows and columns of the die are those of the LED board.
    """
    half = cap.emitter_mm / 2
    radius = cap.hole_mm / 2
    middle_x, middle_y = (cap.height_mm * np.asarray(slope, np.float64)[..., None] for slope in (right, up))
    strips = half * ((2 * np.arange(_STRIPS) + 1) / _STRIPS - 1)
    chord = np.sqrt(np.maximum(radius**2 - (strips + middle_y) ** 2, 0.0))
    free = np.minimum(half, chord - middle_x) - np.maximum(-half, -chord - middle_x)
    return np.asarray(np.clip(free, 0.0, None).mean(axis=-1) / cap.emitter_mm)


def relative_intensity(cap: LedCap, magnification: float, right_deg: ArrayLike, up_deg: ArrayLike) -> Floats:
    """Return the ring's intensity at the eye over that on the axis, in directions off the axis, degrees at the eye.

    A Lambertian die behind a relay that turns an angle psi at the LED into psi / `magnification` (f1 / f2).
    """
    right, up = np.broadcast_arrays(np.asarray(right_deg, np.float64), np.asarray(up_deg, np.float64))
    at_eye = np.radians(np.hypot(right, up))
    at_led = magnification * at_eye
    slope = np.tan(at_led) / np.maximum(np.hypot(right, up), 1e-12)
    denser = np.sinc(at_led / pi) / np.sinc(at_eye / pi)  # sin(psi) / (a sin(theta)): solid angles of the two sides
    return np.asarray(seen_share(cap, slope * right, slope * up) * np.cos(at_led) * denser)


def relative_irradiance(cap: LedCap, magnification: float, angle_deg: ArrayLike) -> Floats:
    """Return the irradiance of a flat retina over that on the axis, mean over all azimuths, by the angle in degrees."""
    angle = np.asarray(angle_deg, np.float64)[..., None]
    turn = np.radians(_TURNS_DEG)
    there = relative_intensity(cap, magnification, angle * np.cos(turn), angle * np.sin(turn))
    return np.asarray(there.mean(axis=-1) * np.cos(np.radians(angle[..., 0])) ** 3)


def half_maximum_deg(cap: LedCap, magnification: float) -> float:
    """Return the field, a full angle, at whose edge a flat retina has half of the irradiance on the axis, degrees."""
    return field_to_share_deg(cap, magnification, 0.5)


def field_to_share_deg(cap: LedCap, magnification: float, share: float) -> float:
    """Return the field, a full angle, at whose edge a flat retina has this share of the axis's irradiance, degrees."""
    half_deg = np.arange(0.0, 60.0, 0.05)
    return float(2 * np.interp(-share, -relative_irradiance(cap, magnification, half_deg), half_deg))


def dark_deg(cap: LedCap, magnification: float) -> float:
    """Return the field, a full angle, outside of which no part of a die is seen, degrees."""
    steepest = (cap.hole_mm + np.sqrt(2) * cap.emitter_mm) / 2 / cap.height_mm
    return float(2 * np.degrees(np.arctan(steepest)) / magnification)


def centre_over_mean(cap: LedCap, magnification: float, field_deg: float) -> float:
    """Return the irradiance on the axis over the whole light spread evenly over the disc of a field, flat retina."""
    edge = dark_deg(cap, magnification) / 2
    half_deg = (np.arange(400) + 0.5) / 400 * edge
    radius = np.tan(np.radians(half_deg))
    widths = np.radians(edge / 400) / np.cos(np.radians(half_deg)) ** 2
    whole = float((relative_irradiance(cap, magnification, half_deg) * 2 * radius * widths).sum())
    return tan(radians(field_deg / 2)) ** 2 / whole


def axis_mw_per_sr(ring_mw: float, magnification: float, transmission: float) -> float:
    """Return the intensity on the axis behind the pupil, mW/sr, of LEDs that radiate `ring_mw` together at full drive.

    A Lambertian LED has its power over pi on its axis; the relay widens angles by 1 / `magnification`.
    """
    return ring_mw / pi * transmission * magnification**2


def highest_mw_per_cm2(intensity_mw_per_sr: float, eye_mm: float) -> float:
    """Return the highest local irradiance of a retina, mW/cm2, E = I / f^2, by the intensity and the eye's length."""
    return intensity_mw_per_sr / (eye_mm / 10) ** 2
