"""Reference pages of the keys of head files and scenes, generated from their models.

`.venv/bin/python -m services.research.key_reference` writes `services/research/site/head_keys.md` and `scene_keys.md`
again; a test compares the files with the models. The meaning of a key is its comment in the model's source.
"""

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic.fields import FieldInfo

from device.config.head_file import InstrumentSpec
from device.config.scene import SimSpec
from device.config.toml_file import Table

SITE = Path(__file__).parent / "site"
HEAD_INTRODUCTION = (
    "A head file (`hardware/heads/*.toml`) describes one optical head. Each section is a table of the file; a "
    "mistyped key is refused with the nearest name. A key without a default is absent, or required: see there. "
    "Units are in the names. The keys of a simulated eye, table `[sim]`, have [a page of their own](scene_keys.md)."
)
SCENE_INTRODUCTION = (
    "A scene (`device/sim/scenes/*.toml`) is a head file with the table `[sim]`: what is in front of the head, and "
    "what is not ideal. Every default is the absence of an effect. Units are in the names. Its other tables are those "
    "of a [head file](head_keys.md); `diffuscope simulate SCENE --explain` prints which effects can be seen."
)
NAMES = {str: "text", bool: "true or false", int: "whole number", float: "number", Path: "path", dict: "table"}
BOUNDS = {Ge: "from {}", Gt: "above {}", Le: "to {}", Lt: "below {}"}


def head_page() -> str:
    """Return the Markdown of the keys of a head file, without those of the scene."""
    tables = [(path, kind) for path, kind in _tables("", InstrumentSpec) if not path.startswith("sim")]
    return _page("Keys of a head file", HEAD_INTRODUCTION, tables)


def scene_page() -> str:
    """Return the Markdown of the keys of the table [sim]."""
    return _page("Keys of a scene", SCENE_INTRODUCTION, list(_tables("sim", SimSpec)))


def _page(title: str, introduction: str, tables: list[tuple[str, type[Table]]]) -> str:
    return "\n\n".join([f"# {title}", introduction, *(_section(path, kind) for path, kind in tables)]) + "\n"


def _tables(path: str, kind: type[Table]) -> Iterator[tuple[str, type[Table]]]:
    """Yield the path and model of a table and of all tables below it."""
    yield path, kind
    for name, found in kind.model_fields.items():
        for inner in _models(found.annotation):
            yield from _tables(f"{path}.{name}".lstrip("."), inner)


def _models(annotation: Any) -> list[type[Table]]:
    if isinstance(annotation, type) and issubclass(annotation, Table):
        return [annotation]
    return [model for argument in get_args(annotation) for model in _models(argument)]


def _section(path: str, kind: type[Table]) -> str:
    """Return the heading of a table, what it is, and a row for each of its keys."""
    meanings = dict(re.findall(r"^    (\w+): .*?  # (.+)$", inspect.getsource(kind), re.M))
    keys = {name: key for name, key in kind.model_fields.items() if not _models(key.annotation)}
    rows = [
        f"| `{name}` | {_kind(key.annotation)} | {_default(key)} | {_range(key)} | {meanings.get(name, '')} |"
        for name, key in keys.items()
    ]
    heading = f"## `[{path}]`" if path else "## At the top"
    words = inspect.getdoc(kind) or ""
    table = ["| key | value | default | range | meaning |", "|---|---|---|---|---|", *rows]
    return "\n\n".join([heading, words, *(["\n".join(table)] if rows else [])])


def _kind(annotation: Any) -> str:
    """Return the values of a key in words; its choices, if it has single ones."""
    if get_origin(annotation) is Literal:
        return ", ".join(f"`{_toml(choice)}`" for choice in get_args(annotation))
    if annotation in NAMES or get_origin(annotation) is dict:
        return NAMES[get_origin(annotation) or annotation]
    inner = get_args(annotation)
    if get_origin(annotation) is tuple:
        return f"list of {_kind(inner[0])}" if inner[-1] is ... else f"{len(inner)} values: {_kind(inner[0])}"
    return " or ".join(
        dict.fromkeys(_kind(member) for member in inner if member is not type(None) and _is_kind(member))
    )


def _is_kind(annotation: Any) -> bool:
    return annotation in NAMES or get_origin(annotation) is not None


def _default(key: FieldInfo) -> str:
    if key.is_required():
        return "required"
    value = key.get_default(call_default_factory=True)
    return "" if value is None or value == {} else f"`{_toml(value)}`"


def _toml(value: Any) -> str:
    """Return a value as a TOML file has it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return f"{value:g}" if isinstance(value, int | float) else f'"{value}"'


def _range(key: FieldInfo) -> str:
    bounds = {type(bound): bound for bound in key.metadata if type(bound) in BOUNDS}
    return ", ".join(
        BOUNDS[kind].format(f"{getattr(bounds[kind], kind.__name__.lower()):g}") for kind in BOUNDS if kind in bounds
    )


PAGES = {"head_keys.md": head_page, "scene_keys.md": scene_page}


if __name__ == "__main__":
    for name, page in PAGES.items():
        (SITE / name).write_text(page(), encoding="utf-8")
