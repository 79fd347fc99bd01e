"""Operating limits of temperature and battery charge: a value equal to its limit is permitted.

The limits of a head are in its file (`BusSpec.warmest_c`, `BusSpec.emptiest`); the head, the health checks, the alerts
and the updater use these comparisons.
"""


def is_too_hot(temperature_c: float, limit_c: float) -> bool:
    """Return whether a temperature exceeds its limit, both in degrees Celsius; false at the limit."""
    return temperature_c > limit_c


def is_battery_low(charge_ratio: float, least_ratio: float) -> bool:
    """Return whether a battery has less than the least charge, both from 0 to 1; false at the least charge."""
    return charge_ratio < least_ratio
