"""Docstrings of the public interface: numpydoc sections that name every parameter, field, result and error."""

import ast
import inspect
import re
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol, get_type_hints, is_typeddict

import diffuscope
import pytest

from device import ports
from device.errors import DiffuscopeError

ROOT = Path(__file__).parents[2]
ENTRY = re.compile(r"\**(?P<name>\w+)(?: : .+)?$")


def sections(docstring: str) -> dict[str, dict[str, str]]:
    """Return the numpydoc sections of a docstring: each by its title, with the text of every entry by its name."""
    lines = inspect.cleandoc(docstring).splitlines()
    found: dict[str, dict[str, str]] = {}
    entries: dict[str, str] = {}
    name = ""
    for line, below in zip(lines, [*lines[1:], ""], strict=True):
        if line and below == "-" * len(line):
            entries = found[line] = {}
        elif found and line and not line.startswith((" ", "-")):
            matched = ENTRY.match(line)
            name = matched["name"] if matched else line
            entries[name] = ""
        elif found and line.startswith(" "):
            entries[name] += line.strip()
    return found


def interface() -> Iterator[tuple[str, Any]]:
    """Yield the public functions and classes with their names: of `diffuscope`, the ports, and recon as others use it.

    Base classes of this project are among them.
    """
    seen: dict[str, Any] = {}
    for name in diffuscope.__all__:
        seen[f"diffuscope.{name}"] = getattr(diffuscope, name)
    for name, kind in inspect.getmembers(ports, inspect.isclass):
        if kind.__module__ == ports.__name__:
            seen[f"ports.{name}"] = kind
    seen |= recon_classes()
    for name, found in list(seen.items()):
        if inspect.isclass(found):
            seen |= {f"{name}({base.__name__})": base for base in found.__mro__[1:] if _is_ours(base)}
    for name, found in seen.items():
        is_error = inspect.isclass(found) and issubclass(found, DiffuscopeError) and found is not DiffuscopeError
        if not is_error and (inspect.isclass(found) or inspect.isfunction(found)):
            yield name, found


def recon_classes() -> dict[str, Any]:
    """Return the classes of `device.recon` that a module outside of it imports."""
    found = {}
    for file in (*(ROOT / "device").rglob("*.py"), *(ROOT / "services").rglob("*.py")):
        if ROOT / "device" / "recon" in file.parents:
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("device.recon"):
                module = import_module(node.module or "")
                for alias in node.names:
                    kind = vars(module).get(alias.name)
                    if inspect.isclass(kind) and kind.__module__ == module.__name__:
                        found[f"{module.__name__}.{alias.name}"] = kind
    return found


def _is_ours(base: type) -> bool:
    return base.__module__.startswith(("device.", "services."))


def faults_of(found: Any) -> list[str]:
    """Return what is wrong in the docstrings of a function, or of a class with its public methods."""
    if not inspect.isclass(found):
        return list(function_faults(found))
    faults = list(class_faults(found))
    for name, member in vars(found).items():
        method = member.__func__ if isinstance(member, classmethod | staticmethod) else member
        if inspect.isfunction(method) and (not name.startswith("_") or name == "__call__"):
            faults += [f"{name}: {fault}" for fault in function_faults(method)]
    return faults


def class_faults(kind: type) -> Iterator[str]:
    """Yield what is wrong in the docstring of a class; its fields are Attributes, constructor arguments Parameters."""
    docstring = kind.__doc__ or ""
    yield from _first_sentence(docstring)
    stated = sections(docstring)
    if is_dataclass(kind) or is_typeddict(kind):
        own = {name for name in inspect.get_annotations(kind) if not name.startswith("_")}
        yield from _differences("Attributes", own - _described_fields(kind), stated)
    elif "__init__" in vars(kind) and not issubclass(type(kind), type(Protocol)):
        init: Any = vars(kind)["__init__"]
        yield from _differences("Parameters", _parameters(init), stated)
        yield from _errors(init, stated)


def _described_fields(kind: type) -> set[str]:
    """Return the fields of a class that are followed by a docstring of their own."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(tree, ast.ClassDef)
    return {
        node.target.id
        for node, after in pairwise(tree.body)
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
    }


def function_faults(function: Callable[..., Any]) -> Iterator[str]:
    """Yield what is wrong in the docstring of a function or a method."""
    docstring = function.__doc__ or ""
    yield from _first_sentence(docstring)
    stated = sections(docstring)
    yield from _differences("Parameters", _parameters(function), stated)
    yield from _errors(function, stated)
    returned = get_type_hints(function).get("return")
    if returned is not type(None) and not {"Returns", "Yields"} & set(stated):
        yield "no Returns"
    if returned is type(None) and "Returns" in stated:
        yield "Returns, but nothing is returned"


def _first_sentence(docstring: str) -> Iterator[str]:
    first = inspect.cleandoc(docstring).split("\n\n")[0]
    if not first.endswith((".", ".)")) or ";" in first:
        yield "the first paragraph is not one plain sentence"


def _differences(title: str, names: set[str], stated: dict[str, dict[str, str]]) -> Iterator[str]:
    entries = stated.get(title, {})
    if missing := names - set(entries):
        yield f"{title} without {', '.join(sorted(missing))}"
    if unknown := set(entries) - names:
        yield f"{title} with the unknown {', '.join(sorted(unknown))}"
    if empty := [name for name, text in entries.items() if not text]:
        yield f"{title} without a text for {', '.join(empty)}"


def _parameters(function: Callable[..., Any]) -> set[str]:
    return set(inspect.signature(function).parameters) - {"self", "cls"}


def _errors(function: Callable[..., Any], stated: dict[str, dict[str, str]]) -> Iterator[str]:
    """Yield the errors that a function raises itself and does not state, and those stated that do not exist."""
    named = set(stated.get("Raises", {}))
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    raised = {
        node.exc.func.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and isinstance(node.exc.func, ast.Name)
    }
    if missing := {name for name in raised if name[0].isupper()} - named:
        yield f"Raises without {', '.join(sorted(missing))}"
    known = {kind.__name__ for kind in _every_subclass(Exception)}
    if unknown := named - known:
        yield f"Raises with the unknown {', '.join(sorted(unknown))}"


def _every_subclass(kind: type) -> Iterator[type]:
    for child in kind.__subclasses__():
        yield child
        yield from _every_subclass(child)


def test_the_public_interface_has_numpydoc_sections() -> None:
    found = {name: faults for name, kind in interface() if (faults := faults_of(kind))}
    assert not found, "\n".join(f"{name}: {'; '.join(faults)}" for name, faults in found.items())


def sized(rows: int, cols: int = 1) -> float:
    """Return the size.

    Parameters
    ----------
    rows
        Number of rows.
    cols : optional
        Number of columns.

    Returns
    -------
    float
        Size in samples.

    Raises
    ------
    ValueError
        No row.
    """
    if rows < 1:
        raise ValueError(rows)
    return float(rows * cols)


def test_a_complete_docstring_has_no_fault() -> None:
    assert faults_of(sized) == []


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("cols : optional\n        Number of columns.", "", "Parameters without cols"),
        ("cols : optional", "columns", "Parameters without cols"),
        ("        Number of rows.\n", "", "Parameters without a text for rows"),
        ("Returns\n    -------\n    float\n        Size in samples.", "", "no Returns"),
        ("ValueError\n        No row.", "", "Raises without ValueError"),
        ("ValueError\n        No row.", "ValueErr\n        No row.", "Raises with the unknown ValueErr"),
        ("Return the size.", "Return the size; it is a float.", "the first paragraph is not one plain sentence"),
    ],
)
def test_an_incomplete_docstring_is_found(old: str, new: str, fault: str) -> None:
    def changed(rows: int, cols: int = 1) -> float:
        if rows < 1:
            raise ValueError(rows)
        return float(rows * cols)

    assert old in str(sized.__doc__)
    changed.__doc__ = str(sized.__doc__).replace(old, new)
    assert fault in faults_of(changed)
