"""Settings of the methods: parameters that a solver chooses from the frame, and that a user may set instead.

The name of a setting is its key in `regularisation` of the report, so the value that the frame chose can be read there.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from device.errors import SettingError

Settings = Mapping[str, float]


@dataclass(frozen=True)
class Setting:
    """A parameter of a method: name, one sentence, and the permitted range, limits included."""

    name: str
    sentence: str
    least: float
    most: float


@runtime_checkable
class ConfigurableSolver(Protocol):
    """A solver that takes settings; the caller has checked their names and ranges with `check_settings`."""

    def configure(self, settings: Settings) -> None:
        """Use these values instead of those of the frame, from the next `start` on."""


MU = Setting("mu", "weight of the prior, relative to |H|^2; by default from cross-validation", 1e-12, 1e6)
TAU = Setting("tau", "weight of the total variation, in 1/DN; by default from the frame's noise or misfit", 1e-12, 1e12)
PRIOR_SLOPE = Setting("prior_slope", "exponent of the prior's power law in the spatial frequency", -2.0, 10.0)
PRIOR_LOG_POWER = Setting("prior_log_power", "natural logarithm of its power, of the unnormalised DFT", -80.0, 80.0)


def check_settings(method: str, known: Iterable[Setting], given: Settings) -> None:
    """Raise SettingError for a name that is not among the settings of a method, or a value out of its range."""
    settings = {setting.name: setting for setting in known}
    for name, value in given.items():
        if name not in settings:
            keys = ", ".join(settings)
            raise SettingError(
                f"the method '{method}' has no setting '{name}'",
                f"Its settings are: {keys}." if keys else "It has none; leave the setting out, or choose a method.",
            )
        setting = settings[name]
        if not setting.least <= value <= setting.most:
            raise SettingError(
                f"{name} = {value:g} is out of its range",
                f"Give {name} a value from {setting.least:g} to {setting.most:g}, or leave it out.",
            )
