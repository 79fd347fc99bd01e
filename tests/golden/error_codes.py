"""Every error code with its remedy, HTTP status and message templates, and every sentence for users in the sources."""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from device.errors import DiffuscopeError
from services.http.problem_responses import problem_response
from tests.golden import compare
from tests.project_files import nodes, parsed, python_files, text

CODE = re.compile(r"[a-z]+(?:\.[a-z-]+)+")
FILE = re.compile(
    r".*\.(?:png|jpe?g|tiff?|npy|npz|json|jsonl|toml|sqlite|txt|html|css|js|mjs|py|md|svg|zip|raucb|local)"
)
SENTENCE = re.compile(r"[A-Z{][^\n ]* [^\n ]* [^\n]*[.?!]")  # at least three words; linear in the length
SOURCES = ("device/", "services/")


def errors() -> dict[str, Any]:
    """Return every error by its code: its parent's code, built-in bases, default remedy, HTTP status, templates."""
    kinds = {kind.__name__: kind for kind in _kinds(DiffuscopeError)}
    templates = _templates(kinds)
    return {
        kind.code: {
            "parent": next((base.code for base in kind.__bases__ if issubclass(base, DiffuscopeError)), None),
            "also": sorted(base.__name__ for base in kind.__bases__ if not issubclass(base, DiffuscopeError)),
            "remedy": kind.default_remedy,
            "status": problem_response(kind("message")).status_code,
            "templates": [list(one) for one in sorted(templates[kind.code])],
        }
        for kind in kinds.values()
    }


def codes() -> list[str]:
    """Return every text of the form `word.word` that is no file name: codes of errors, verdicts, alerts and faults."""
    return sorted(one for one in _all_texts() if CODE.fullmatch(one) and not FILE.fullmatch(one))


def sentences() -> list[str]:
    """Return every sentence for users in the sources: remedies of checks and findings, messages, help texts."""
    return sorted(one for one in _all_texts() if SENTENCE.fullmatch(one))


@cache
def _all_texts() -> frozenset[str]:
    """Return the template of every text in the sources, except docstrings and the scripts of the documentation."""
    found = set[str]()
    for name in python_files(*SOURCES):
        if name.startswith("services/research/site/"):
            continue
        inside = {id(part) for node in nodes(text(name)) if isinstance(node, ast.JoinedStr) for part in node.values}
        docs = {id(node.value) for node in nodes(text(name)) if isinstance(node, ast.Expr)}
        for node in nodes(text(name)):
            if isinstance(node, ast.Constant | ast.JoinedStr | ast.BinOp) and id(node) not in inside | docs:
                found |= set(_texts(node, {}))
    return frozenset(found)


def _kinds(kind: type[DiffuscopeError]) -> Iterator[type[DiffuscopeError]]:
    yield kind
    for child in kind.__subclasses__():
        if child.__module__.split(".")[0] in ("device", "services"):
            yield from _kinds(child)


def _templates(kinds: dict[str, type[DiffuscopeError]]) -> defaultdict[str, set[tuple[str, str]]]:
    """Return (message, remedy) of every place that makes an error; inserted values are `{}`."""
    found, everywhere = defaultdict[str, set[tuple[str, str]]](set), {}
    for name in python_files(*SOURCES):
        everywhere |= _constants(name)
    for name in python_files(*SOURCES):
        known = everywhere | _constants(name)
        for node in nodes(text(name)):
            if isinstance(node, ast.Call) and (called := ast.unparse(node.func).split(".")[-1]) in kinds and node.args:
                given = node.args[1:2] + [one.value for one in node.keywords if one.arg == "remedy"]
                remedies = _texts(given[0], known) if given else [""]
                found[kinds[called].code] |= {(words, do) for words in _texts(node.args[0], known) for do in remedies}
    return found


def _constants(name: str) -> dict[str, str]:
    """Return the named string constants of a module."""
    return {
        ast.unparse(node.targets[0]): _texts(node.value, {})[0]
        for node in parsed(text(name)).body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant | ast.BinOp | ast.JoinedStr)
    }


def _texts(node: ast.expr, known: Mapping[str, str]) -> list[str]:
    """Return the template of an expression, with names looked up in `known`.

    A conditional expression has a template per branch.
    """
    match node:
        case ast.Constant(value=str(words)):
            return [words]
        case ast.JoinedStr(values=parts):
            return ["".join(_texts(one, known)[0] for one in parts)]
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return [f"{first}{second}" for first in _texts(left, known) for second in _texts(right, known)]
        case ast.IfExp(body=body, orelse=other):
            return [*_texts(body, known), *_texts(other, known)]
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return [known.get(name, "{}")]
        case _:
            return ["{}"]


def record() -> dict[str, Any]:
    """Return the errors by code, all other codes, and all sentences."""
    return {"errors": errors(), "codes": codes(), "sentences": sentences()}


def write() -> Path:
    """Write the record of codes and sentences."""
    compare.write("errors", record())
    return compare.RECORDS / "errors.json"
