"""Bundler: an ES module with all its imports as one file, so that a browser sends one request instead of thirty.

Source lines stay as they are in `web/`, except for import and export lines; comments of whole lines are left out. Each
module becomes a function, called once, in the order in which a browser evaluates modules. Modules that are loaded on
demand import the bundled ones through re-export stubs of the same names, so that both see the same objects. A
browser resolves an `import()` in a bundled module from the address of the entry: its path is relative to the entry.
"""

import re
from collections.abc import Callable
from posixpath import dirname, join, normpath, relpath

_IMPORT = re.compile(r'^import (?:([^;"]*?) from )?"(\.[^"]+)";', re.M)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const) (?:(\w+)|\{([^}]*)\}))", re.M)
_LIST = re.compile(r"\bexport ?\{([^{}]*)\};?\s*(?://.*\s*)?\Z")  # the export list at the end of a vendored module
_UNSUPPORTED = re.compile(r"^(?:import|export)\b.*|^.*\bimport\.meta\b.*|^.*\bimport\((?!\"\.).*", re.M)
_ON_DEMAND = re.compile(r'(?<=\bimport\()"(\.[^"]+)"')
_COMMENT = re.compile(r"^[ \t]*(?:/\*\*(?:(?!\*/).)*\*/|//[^\n]*)\n", re.M | re.S)  # of whole lines
_SHEET = re.compile(r'^@import "([^"]+)";$', re.M)

Read = Callable[[str], str]


def bundle_module(entry: str, read: Read) -> dict[str, str]:
    """Return the bundle of module `entry` and the re-export stubs of its imports: text by file name.

    `read` returns the text of a file. ValueError for unsupported syntax or an import cycle.
    """
    order: list[str] = []
    _walk(entry, read, order, ())
    bodies = {name: _Module(name, _COMMENT.sub("", read(name)), entry) for name in order}
    last = bodies.pop(entry)
    parts = [body.as_part() for body in bodies.values()]
    shared = ", ".join(f'"{name}": {_identifier(name)}' for name in bodies)
    whole = (
        "".join(parts)
        + f"export const parts = {{ {shared} }};\n\n// ---- {entry}\n(async () => {{\n{last.text}}})();\n"
    )
    return {entry: whole} | {name: body.re_export() for name, body in bodies.items()}


def bundle_style_sheet(entry: str, read: Read) -> str:
    """Return the style sheet `entry` with each of its @import lines replaced by the text of that sheet (one level)."""
    return _SHEET.sub(lambda found: read(normpath(join(dirname(entry), found[1]))), read(entry))


def _walk(name: str, read: Read, order: list[str], above: tuple[str, ...]) -> None:
    """Append module `name` to `order`, after its imports; `above` are its importers. ValueError for an import cycle."""
    if name in above:
        raise ValueError(f"modules import each other in a ring: {' -> '.join((*above, name))}")
    if name in order:
        return
    for found in _IMPORT.finditer(read(name)):
        _walk(normpath(join(dirname(name), found[2])), read, order, (*above, name))
    order.append(name)


class _Module:
    """Text of a module for the bundle, without its import and export statements, and its exported names."""

    def __init__(self, name: str, text: str, entry: str) -> None:
        self._name, self._entry = name, entry
        exports = ",".join(found[1] or found[2] for found in _EXPORT.finditer(text))
        text = _EXPORT.sub("", text)
        if ending := _LIST.search(text):
            exports += "," + ending[1]
            text = text[: ending.start()] + "\n"
        pairs = [export.split(" as ") for export in exports.split(",") if export.strip()]
        self._exports = {pair[-1].strip(): pair[0].strip() for pair in pairs}  # exported name: local name
        self.text = _IMPORT.sub(self._import_statement, text)
        if left := _UNSUPPORTED.search(self.text):
            raise ValueError(f"{name}: {left[0][:80]!r} is written in a way that cannot be joined")
        self.text = _ON_DEMAND.sub(self._on_demand, self.text)

    def _import_statement(self, found: re.Match[str]) -> str:
        """Return the replacement of an import: its names bound to the exports of that module; "" without names."""
        if found[1] is None:
            return ""
        names = found[1].removeprefix("* as ").replace(" as ", ": ")
        return f"const {names} = {_identifier(normpath(join(dirname(self._name), found[2])))};"

    def _on_demand(self, found: re.Match[str]) -> str:
        """Return the quoted path of an `import()`, relative to the entry, in whose file the bundled module runs."""
        return f'"{_relative(normpath(join(dirname(self._name), found[1])), self._entry)}"'

    def as_part(self) -> str:
        """Return the text of the module as a function that is called once and returns the exports."""
        exports = ", ".join(f"{name}: {own}" for name, own in self._exports.items())
        head = f"// ---- {self._name}\nconst {_identifier(self._name)} = (() => {{\n"
        return f"{head}{self.text}return {{ {exports} }};\n}})();\n\n"

    def re_export(self) -> str:
        """Return the text of the re-export stub: a module of the same name that exports the bundled objects."""
        at = _relative(self._entry, self._name)
        exports = f'export const {{ {", ".join(self._exports)} }} = parts["{self._name}"];'
        return f'import {{ parts }} from "{at}";\n{exports}\n'


def _relative(target: str, module: str) -> str:
    """Return the path of file `target` relative to the folder of `module`, with a leading `./` or `../`."""
    path = relpath(target, dirname(module) or ".")
    return path if path.startswith(".") else f"./{path}"


def _identifier(name: str) -> str:
    return "of_" + re.sub(r"\W", "_", name)
