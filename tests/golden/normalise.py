"""Replacement of values that differ from run to run by placeholders: names, times, measured numbers, digests, paths."""

import re
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

TIME = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?(?:\+\d\d:\d\d|Z)?"
NAMED = (  # names are numbered by first appearance, so that equal names stay equal
    ("capture", r"\b\d{8}T\d{6}-O[DS]-[0-9a-f]{6}\b"),
    ("visit", r"\b\d{8}T\d{6}-[0-9a-f]{6}\b"),
    ("id", r"\b(?!0{8})[0-9a-f]{16}\b"),
)
# floats below these are measured
MEASURED = {"report", "numbers", "verdict", "measured", "found", "placed", "times", "x-aim"}
COUNTS = {
    "free_bytes",
    "size_bytes",
    "undoable_bytes",
    "space_left",
    "people_left",
    "takes_s",
    "took_s",
    "left_s",
    "spent_s",
    "missed",
}
SENTENCES = {"message", "remedy", "sentence"}  # their words stand in one place, the source
TIMED = {"pareto", "dominated", "within_budget", "chosen"}  # conclusions of the explorer from times of the computer
MACHINE = {"cpu", "cores", "system"}  # description of the computer in a measured frontier
OF_THE_LOAD = {"psf_cylinder"}  # parts of a report that only an estimate in time has
OF_THE_COMPUTER = {"clock", "heat", "speed"}  # health checks whose value depends on the computer


class Normaliser:
    """Placeholders for one transcript; `folder` is its temporary folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = str(folder)
        self._names: dict[str, str] = {}
        self._counts: dict[str, int] = {}

    def text(self, plain: str) -> str:
        """Return a text with its names, times and paths replaced."""
        plain = plain.replace(self._folder, "<folder>")
        for kind, pattern in NAMED:
            plain = re.sub(pattern, self._numbered(kind), plain)
        plain = re.sub(r"\b[0-9a-f]{64}\b", "<sha256>", plain)
        plain = re.sub(r"/web/[0-9a-f]{12}/", "/web/<mark>/", plain)
        plain = re.sub(r"login=[\w-]{20,}", "login=<token>", plain)
        plain = re.sub(r"\bin frame \d+\b", "in frame <number>", plain)  # how many came before depends on the load
        plain = re.sub(TIME, "<time>", plain)
        return re.sub(r"\b\d{4}-\d\d-\d\d( \d\d:\d\d)?\b", "<date>", plain)

    def json(self, value: Any, key: str = "", measured: bool = False) -> Any:
        """Return a JSON value with its texts and its measured floats replaced."""
        measured = measured or key in MEASURED
        if key in MACHINE and not isinstance(value, Mapping):  # a mapping is a schema of the interface
            return "<of the computer>"
        if key in SENTENCES and value and isinstance(value, str):
            return "<sentence>"
        if isinstance(value, str):
            replaced = "<version>" if value == version("diffuscope") else self.text(value)
            return re.sub(r"-?\d+\.\d+", "<number>", replaced) if measured else replaced
        if key in TIMED:
            return "<timed>"
        if isinstance(value, list | tuple):
            return [self.json(entry, key, measured) for entry in value]
        if isinstance(value, Mapping):
            if "unit" in value and "limit" in value:  # a finding about the calibration
                value = value | {"value": "<number>"}
            if value.get("name") in OF_THE_COMPUTER and "limit" in value:
                value = value | dict.fromkeys(("value", "known", "ok", "remedy"), "<of the computer>")
            kept = {name: entry for name, entry in value.items() if not (measured and name in OF_THE_LOAD)}
            return {self.text(str(name)): self.json(entry, str(name), measured) for name, entry in kept.items()}
        if isinstance(value, bool) or value is None:
            return value
        return "<number>" if key in COUNTS or (measured and isinstance(value, float)) else value

    def _numbered(self, kind: str) -> Callable[[re.Match[str]], str]:
        def name(found: re.Match[str]) -> str:
            if found[0] not in self._names:
                self._counts[kind] = self._counts.get(kind, 0) + 1
                self._names[found[0]] = f"<{kind} {self._counts[kind]}>"
            return self._names[found[0]]

        return name
