"""Methods of a researcher's command: the built-in ones, those of installed packages, or one of a Python file.

This is the only place that adds methods to the built-in table; the table itself is never changed. The instrument uses
the built-in table alone (decision 0011). The solver of a plug-in is checked while it runs: exceptions, a wrong type,
and a picture that is not finite become one sentence that names the plug-in.
"""

from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import EntryPoint

import numpy as np

from device import plugins
from device.plugins import Plugin
from device.recon.method_settings import ConfigurableSolver, Settings
from device.recon.methods import METHODS, Method, unknown_method_error
from device.recon.model.fft_plans import Planner
from device.recon.model.forward_model import Model
from device.recon.model.preprocessing import Linear
from device.recon.solvers.solver import Diagnostics, Solver
from device.values import Calibration, Image

NEEDED = ("input_buffer", "diagnostics", "refocus", "start", "step", "finish")


def available_methods() -> dict[str, Method]:
    """Return the built-in and all installed methods by name, the built-in first; every plug-in is loaded.

    SettingError names the package of a plug-in that cannot be loaded, is no `Method`, or has the name of another one.
    """
    entries = plugins.installed(plugins.METHODS)
    return {**METHODS, **{name: _installed(entry) for name, entry in entries.items()}}


def find_method(name: str) -> Method:
    """Return the built-in method of that name, else the installed one, else the one of a file, `FILE.py:NAME`.

    Only the named plug-in is loaded. SettingError for an unknown name, and as `available_methods`.
    """
    if name in METHODS:
        return METHODS[name]
    if ".py:" in name:
        plugin, found = plugins.load_from_file(name)
        return _checked(plugin, found)
    entries = plugins.installed(plugins.METHODS)
    if name not in entries:
        raise unknown_method_error(name, [*METHODS, *entries])
    return _installed(entries[name])


def _installed(entry: EntryPoint) -> Method:
    plugin = plugins.described(entry)
    if entry.name in METHODS:
        raise plugin.error("has the name of a built-in method")
    method = _checked(plugin, plugins.load(entry))
    if method.name != entry.name:
        raise plugin.error(f"is a Method of another name, '{method.name}'")
    return method


def _checked(plugin: Plugin, found: object) -> Method:
    """Return the loaded method with checks around its solver; SettingError if it is no valid `Method`."""
    if not isinstance(found, Method):
        raise plugin.error(f"is no device.recon.methods.Method but of type {type(found).__name__}")
    if found.name in METHODS:
        raise plugin.error(f"has the name '{found.name}' of a built-in method")
    if not isinstance(found.rounds, int) or not isinstance(found.round_pairs, int):
        raise plugin.error(f"has rounds = {found.rounds!r} and round_pairs = {found.round_pairs!r}; both are integers")
    if found.rounds < 0 or (found.rounds == 0) != (found.round_pairs == 0):
        raise plugin.error(f"has rounds = {found.rounds} with round_pairs = {found.round_pairs}; give both, or neither")
    build = found.build

    def build_checked(model: Model, calibration: Calibration, planner: Planner) -> Solver:
        with plugin.errors("be planned"):
            solver = build(model, calibration, planner)
            missing = [name for name in NEEDED if not hasattr(solver, name)]
        if missing:
            raise plugin.error(f"builds a {type(solver).__name__} without `{missing[0]}` of the interface Solver")
        return CheckedSolver(plugin, solver, model)

    return replace(found, build=build_checked)


class CheckedSolver:
    """Solver of a plug-in with the checks of its results; a failure is a SettingError that names the plug-in."""

    def __init__(self, plugin: Plugin, solver: Solver, model: Model) -> None:
        self._plugin, self._solver = plugin, solver
        self.input_buffer: Image | None = solver.input_buffer
        self._refuse_wrong_buffer(model.grid.window)

    def _refuse_wrong_buffer(self, window: tuple[int, int]) -> None:
        """Raise SettingError unless the buffer is None or fits; compiled code writes to it without further checks."""
        buffer = self.input_buffer
        if buffer is None:
            return
        is_array = isinstance(buffer, np.ndarray)
        if not is_array or buffer.dtype != np.float32 or buffer.shape != window or not buffer.flags.c_contiguous:
            raise self._plugin.error(f"has an input_buffer that is no float32 array of {window} in C order")

    @property
    def diagnostics(self) -> Diagnostics:
        """Parameters and figures of the last frame, as the plug-in gives them."""
        with self._plugin.errors("give its diagnostics"):
            given = self._solver.diagnostics
        if not isinstance(given, Diagnostics):
            raise self._plugin.error(f"has diagnostics of type {type(given).__name__} instead of Diagnostics")
        return given

    def configure(self, settings: Settings) -> None:
        """Pass the settings to the plug-in; SettingError if its solver takes none."""
        solver = self._solver
        if not isinstance(solver, ConfigurableSolver):
            raise self._plugin.error("has settings, but its solver has no `configure`")
        self._run("be configured", lambda: solver.configure(settings))

    def refocus(self) -> None:
        """Pass the changed OTF to the plug-in."""
        self._run("refocus", self._solver.refocus)

    def start(self, frame: Linear) -> None:
        """Pass a frame to the plug-in."""
        self._run("start", lambda: self._solver.start(frame))

    def step(self) -> None:
        """Run one round of the plug-in."""
        self._run("run a round", self._solver.step)

    def finish(self, out: Image) -> None:
        """Write the picture of the plug-in to `out`; SettingError if a sample is not finite or not written."""
        out.fill(np.nan)
        self._run(f"write a picture of {out.shape[0]} x {out.shape[1]}", lambda: self._solver.finish(out))
        if not np.isfinite(out).all():
            raise self._plugin.error("gave a picture with samples that are NaN, infinite or not written")

    def _run(self, doing: str, call: Callable[[], None]) -> None:
        with self._plugin.errors(doing):
            call()
