"""Effects of a scene: the built-in ones, and those of installed packages that the scene names.

This is the only place that adds effects to the built-in registry, which itself is never changed. A plug-in is loaded if
the scene has its table [sim.effects.NAME], so that a scene file gives the same frames whatever else is installed.
"""

from importlib.metadata import EntryPoint
from math import isfinite

import numpy as np

from device import plugins
from device.errors import SettingError
from device.plugins import Plugin
from device.sim.effects import EFFECTS
from device.sim.effects.effect import Effect
from device.sim.optical_setup import OpticalSetup, Scene, Size

NEEDED = ("name", "size", "apply")


def effects_of(scene: Scene) -> tuple[Effect, ...]:
    """Return the built-in effects in the order of the light path, then those of plug-ins in the order of the scene.

    SettingError names the package of a plug-in that is missing, cannot be loaded, or is no effect.
    """
    named = scene.sim.effects
    if not named:
        return EFFECTS
    entries = plugins.installed(plugins.EFFECTS)
    if missing := [name for name in named if name not in entries]:
        raise SettingError(
            f"no installed package has the effect '{missing[0]}'",
            f"Install the package that declares it under {plugins.EFFECTS}.",
        )
    return (*EFFECTS, *(_installed(entries[name]) for name in named))


def _installed(entry: EntryPoint) -> Effect:
    plugin = plugins.described(entry)
    built_in = [effect.name for effect in EFFECTS]
    if entry.name in built_in:
        raise plugin.error("has the name of a built-in effect")
    found = plugins.load(entry)
    if isinstance(found, type):
        raise plugin.error(f"is the class {found.__name__}; declare an object of it")
    return CheckedEffect(plugin, found)


class CheckedEffect:
    """Effect of a plug-in with checks of its results; a failure is a SettingError that names the plug-in."""

    def __init__(self, plugin: Plugin, effect: object) -> None:
        self._plugin = plugin
        self._effect = self._required(effect)
        self.name = plugin.name
        if self._effect.name != plugin.name:
            raise plugin.error(f"is an effect of another name, '{self._effect.name}'")

    def _required(self, effect: object) -> Effect:
        """Return the loaded object as an effect; SettingError if it lacks a part of the interface."""
        if missing := [name for name in NEEDED if not hasattr(effect, name)]:
            raise self._plugin.error(
                f"is of type {type(effect).__name__}, without `{missing[0]}` of the interface Effect"
            )
        assert isinstance(effect, Effect)
        return effect

    def size(self, scene: Scene) -> Size:
        """Return the size that the plug-in gives; SettingError unless its eta is a number of at least 0."""
        with self._plugin.errors("give its size"):
            size = self._effect.size(scene)
        if not isinstance(size, Size) or not isfinite(size.eta) or size.eta < 0:
            raise self._plugin.error(f"gave the size {size!r}; it is a Size with an eta of at least 0")
        return size

    def apply(self, setup: OpticalSetup) -> None:
        """Let the plug-in change the setup; SettingError if it fails or leaves arrays that cannot be rendered."""
        shape = setup.object.shape
        with self._plugin.errors("be applied"):
            self._effect.apply(setup)
        self._refuse("object", setup.object, shape)
        if setup.response is not None:
            self._refuse("response", setup.response, setup.shape)

    def _refuse(self, what: str, array: object, shape: tuple[int, ...]) -> None:
        """Raise SettingError unless an array of the setup is finite and of this shape."""
        if not isinstance(array, np.ndarray) or array.shape != shape or not np.isfinite(array).all():
            raise self._plugin.error(f"left a setup whose {what} is no finite array of {' x '.join(map(str, shape))}")
