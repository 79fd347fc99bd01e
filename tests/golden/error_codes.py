"""Every error code with its parent, built-in bases and HTTP status, and every other code in the sources."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from device.errors import DiffuscopeError
from services.http.problem_responses import problem_response
from tests.golden import compare
from tests.project_files import nodes, python_files, text

CODE = re.compile(r"[a-z]+(?:\.[a-z-]+)+")
FILE = re.compile(
    r".*\.(?:png|jpe?g|tiff?|npy|npz|json|jsonl|toml|sqlite|txt|html|css|js|mjs|py|md|svg|zip|raucb|local)"
)
SOURCES = ("device/", "services/")


def errors() -> dict[str, Any]:
    """Return every error by its code: its parent's code, built-in bases and HTTP status."""
    return {
        kind.code: {
            "parent": next((base.code for base in kind.__bases__ if issubclass(base, DiffuscopeError)), None),
            "also": sorted(base.__name__ for base in kind.__bases__ if not issubclass(base, DiffuscopeError)),
            "status": problem_response(kind("message")).status_code,
        }
        for kind in _kinds(DiffuscopeError)
    }


def codes() -> list[str]:
    """Return every text of the form `word.word` that is no file name: codes of errors, verdicts, alerts and faults."""
    texts = {
        node.value
        for name in python_files(*SOURCES)
        if not name.startswith("services/research/site/")
        for node in nodes(text(name))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    return sorted(literal for literal in texts if CODE.fullmatch(literal) and not FILE.fullmatch(literal))


def _kinds(kind: type[DiffuscopeError]) -> Iterator[type[DiffuscopeError]]:
    yield kind
    for child in kind.__subclasses__():
        if child.__module__.split(".")[0] in ("device", "services"):
            yield from _kinds(child)


def record() -> dict[str, Any]:
    """Return the errors by code, and all codes."""
    return {"errors": errors(), "codes": codes()}


def write() -> Path:
    """Write the record of codes."""
    compare.write("errors", record())
    return compare.RECORDS / "errors.json"
