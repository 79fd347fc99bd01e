"""Plug-ins: objects that installed packages declare as entry points, loaded by name; their errors name the package.

An entry point is declared in the pyproject.toml of the other package:

    [project.entry-points."diffuscope.methods"]
    fista = "own_solver:METHOD"

Only the listing of the names reads the metadata of all packages; no code of a plug-in runs before `load`.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

from device.errors import DiffuscopeError, SettingError

METHODS, EFFECTS = "diffuscope.methods", "diffuscope.effects"


@dataclass(frozen=True)
class Plugin:
    """Plug-in that is not loaded yet: its name, its description for messages, and where to repair it."""

    name: str
    label: str
    origin: str

    def error(self, cause: str) -> SettingError:
        """Return the error of this plug-in: one sentence, and the place to repair."""
        return SettingError(f"{self.label} {cause}", f"Repair {self.origin}, or uninstall it.")

    @contextmanager
    def errors(self, doing: str) -> Iterator[None]:
        """Turn any exception of the plug-in's code into a SettingError that names the plug-in; `doing` is a verb.

        Errors of Diffuscope pass unchanged, since they have a sentence and a remedy of their own.
        """
        try:
            yield
        except DiffuscopeError:
            raise
        except Exception as error:  # code of other people may raise anything; none of it is hidden
            cause = str(error).strip().splitlines()
            text = f"{type(error).__name__}: {cause[0]}" if cause else type(error).__name__
            raise self.error(f"cannot {doing}: {text}") from error


def installed(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name; SettingError if two packages declare the same name."""
    found: dict[str, EntryPoint] = {}
    for entry in sorted(entry_points(group=group), key=lambda entry: (entry.name, _package(entry))):
        if entry.name in found:
            raise SettingError(
                f"the packages {_package(found[entry.name])} and {_package(entry)} both declare '{entry.name}' "
                f"in {group}",
                "Rename one of the two entry points, or uninstall one of the packages.",
            )
        found[entry.name] = entry
    return found


def described(entry: EntryPoint) -> Plugin:
    """Return the description of an installed plug-in, which is not loaded."""
    kind = entry.group.rpartition(".")[2].removesuffix("s")
    package = _package(entry)
    return Plugin(entry.name, f"the {kind} '{entry.name}' of the package {package}", f"{entry.value} in {package}")


def load(entry: EntryPoint) -> object:
    """Return the object that an entry point names; SettingError if its module cannot be imported or has no such name.

    Its code runs with the rights of this process.
    """
    with described(entry).errors("be loaded"):
        return entry.load()


def load_from_file(place: str) -> tuple[Plugin, object]:
    """Return the object NAME of a module given as `FILE.py:NAME`, with its description.

    SettingError if there is no such file, if the module cannot be imported, or if it has no such name.
    """
    file, _, name = place.rpartition(":")
    path = Path(file)
    plugin = Plugin(name, f"'{name}' of {path}", str(path))
    if not path.is_file():
        raise SettingError(f"there is no file {path}", "Give the method as FILE.py:NAME.")
    module = _imported(plugin, path)
    if name not in vars(module):
        raise SettingError(f"{path} has no '{name}'", "Give the name of the object after the colon: FILE.py:NAME.")
    return plugin, vars(module)[name]


def _imported(plugin: Plugin, path: Path) -> ModuleType:
    spec = spec_from_file_location(f"diffuscope_file_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise plugin.error("is no Python module")
    module = module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up there
    with plugin.errors("be loaded"):
        spec.loader.exec_module(module)
    return module


def _package(entry: EntryPoint) -> str:
    return "unknown" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
