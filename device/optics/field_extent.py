"""Extent of the field's light on the sensor: shift of the caustic at the field's edge, and what a sensor side captures.

Fields are full angles at the eye; the paper's section "Hardware design", OPTICS.md 1.2 and 1.5.
"""

from math import acos, degrees, pi, radians, sqrt, tan

from device.optics.eye import Relay


def half_shift_mm(relay: Relay, field_deg: float) -> float:
    """Return s = a f_d theta / 2, the caustic's shift at the field's edge, mm (paper, small angles)."""
    return relay.angular_magnification * relay.diffuser_to_sensor_mm * radians(field_deg) / 2


def half_shift_tan_mm(relay: Relay, field_deg: float) -> float:
    """Return the caustic's shift at the field's edge for an ideal (f-tan) relay, mm."""
    return relay.angular_magnification * relay.diffuser_to_sensor_mm * tan(radians(field_deg / 2))


def extent_mm(relay: Relay, field_deg: float) -> float:
    """Return d + 2 s, the sensor side that captures all light of the field (paper's rule D > d + 2 s), mm."""
    return relay.iris_mm + 2 * half_shift_mm(relay, field_deg)


def strict_field_deg(relay: Relay, sensor_mm: float) -> float:
    """Return the widest field by the paper's rule D > d + 2 s on a sensor side D, degrees; 0 if D < d."""
    free_mm = sensor_mm - relay.iris_mm
    return max(0.0, degrees(free_mm / (relay.angular_magnification * relay.diffuser_to_sensor_mm)))


def captured_share(relay: Relay, field_deg: float, sensor_mm: float) -> float:
    """Return the share of the light of a point at the field's edge that a sensor of that side captures.

    0 to 1; the other side of the sensor is not considered. OPTICS.md 1.5.
    """
    u = (sensor_mm / 2 - half_shift_mm(relay, field_deg)) / (relay.iris_mm / 2)
    u = max(-1.0, min(1.0, u))
    return 1 - (acos(u) - u * sqrt(1 - u * u)) / pi


def half_captured_field_deg(relay: Relay, sensor_mm: float) -> float:
    """Return the field at whose edge a sensor of that side captures half the light, degrees; OPTICS.md 1.5."""
    return degrees(sensor_mm / (relay.angular_magnification * relay.diffuser_to_sensor_mm))
