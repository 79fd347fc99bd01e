"""A module with all that it imports in one answer, so that a browser asks once and not thirty times.

The text stays as it is in `web/`; only the lines that cross from one module to another are written anew. Each module
becomes a function that is run once, in the order in which a browser would run them. What is loaded on demand may import
any of them: a stand-in with the module's name hands out the very same objects.
"""

import re
from collections.abc import Callable
from posixpath import dirname, join, normpath, relpath

_IMPORT = re.compile(r'^import (?:([^;"]*?) from )?"(\.[^"]+)";', re.M)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const) (?:(\w+)|\{([^}]*)\}))", re.M)
_LIST = re.compile(r"\bexport ?\{([^{}]*)\};?\s*(?://.*\s*)?\Z")  # how a vendored module ends
_LEFT = re.compile(r"^(?:import|export)\b.*|^.*\bimport\.meta\b.*", re.M)
_SHEET = re.compile(r'^@import "([^"]+)";$', re.M)

Read = Callable[[str], str]


def joined(entry: str, read: Read) -> dict[str, str]:
    """The entry with its imports, and a stand-in for each of them, by name; ValueError for what cannot be joined."""
    order: list[str] = []
    _walk(entry, read, order, ())
    bodies = {name: _Body(name, read(name)) for name in order}
    last = bodies.pop(entry)
    parts = [body.as_part() for body in bodies.values()]
    shared = ", ".join(f'"{name}": {_called(name)}' for name in bodies)
    whole = (
        "".join(parts)
        + f"export const parts = {{ {shared} }};\n\n// ---- {entry}\n(async () => {{\n{last.text}}})();\n"
    )
    return {entry: whole} | {name: body.stand_in(entry) for name, body in bodies.items()}


def joined_sheet(entry: str, read: Read) -> str:
    """A style sheet that only imports others, as one."""
    return _SHEET.sub(lambda found: read(normpath(join(dirname(entry), found[1]))), read(entry))


def _walk(name: str, read: Read, order: list[str], above: tuple[str, ...]) -> None:
    """Every module after those that it imports, as a browser runs them."""
    if name in above:
        raise ValueError(f"modules import each other in a ring: {' -> '.join((*above, name))}")
    if name in order:
        return
    for found in _IMPORT.finditer(read(name)):
        _walk(normpath(join(dirname(name), found[2])), read, order, (*above, name))
    order.append(name)


class _Body:
    """A module's text without imports and exports, and the names that it gave away."""

    def __init__(self, name: str, text: str) -> None:
        self._name = name
        given = ",".join(found[1] or found[2] for found in _EXPORT.finditer(text))
        text = _EXPORT.sub("", text)
        if ending := _LIST.search(text):
            given += "," + ending[1]
            text = text[: ending.start()] + "\n"
        pairs = [one.split(" as ") for one in given.split(",") if one.strip()]
        self._given = {pair[-1].strip(): pair[0].strip() for pair in pairs}  # the name outside, and the one inside
        self.text = _IMPORT.sub(self._taken, text)
        if left := _LEFT.search(self.text):
            raise ValueError(f"{name}: {left[0][:80]!r} is written in a way that cannot be joined")

    def _taken(self, found: re.Match[str]) -> str:
        """What stands for an import: the names, from the part of that name."""
        if found[1] is None:
            return ""
        names = found[1].removeprefix("* as ").replace(" as ", ": ")
        return f"const {names} = {_called(normpath(join(dirname(self._name), found[2])))};"

    def as_part(self) -> str:
        """The function that stands for it, and what that gave away."""
        given = ", ".join(f"{name}: {own}" for name, own in self._given.items())
        head = f"// ---- {self._name}\nconst {_called(self._name)} = (() => {{\n"
        return f"{head}{self.text}return {{ {given} }};\n}})();\n\n"

    def stand_in(self, entry: str) -> str:
        """A module of the same name, with the same objects."""
        at = relpath(entry, dirname(self._name) or ".")
        at = at if at.startswith(".") else f"./{at}"
        given = f'export const {{ {", ".join(self._given)} }} = parts["{self._name}"];'
        return f'import {{ parts }} from "{at}";\n{given}\n'


def _called(name: str) -> str:
    return "of_" + re.sub(r"\W", "_", name)
