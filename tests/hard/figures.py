"""The figures of the README: `python -m tests.hard.figures` runs the tests with bounds and writes what they saw.

Every call of `within` is kept in `margins.json`, by test; the README's table holds the worst of each test function.
"""

import json
import re
import sys
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

import pytest

HERE = Path(__file__).parent
MARGINS, README = HERE / "margins.json", HERE / "README.md"
FILES = ("test_bounds.py", "test_stability.py")
RECORDER = "margins-recorder"
BEGIN, END = "<!-- margins: made by python -m tests.hard.figures -->", "<!-- end of margins -->"
Margins = Mapping[str, list[list[float]]]


class Recorder:
    """A plugin of pytest that keeps what tests say of their margins."""

    def __init__(self) -> None:
        self.margins: dict[str, list[list[float]]] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep the margins of a test that passed."""
        if report.when == "call" and report.passed:
            found = [value for name, value in report.user_properties if name == "margin"]
            if found:
                self.margins[report.nodeid] = found


@cache
def recorded() -> Margins:
    """What was recorded: for each test the (measured, bound) of its calls in order; empty before the first time."""
    return json.loads(MARGINS.read_text(encoding="utf-8")) if MARGINS.exists() else {}


def table(margins: Margins) -> str:
    """The worst margin of each test function, as Markdown."""
    worst: dict[str, tuple[float, float]] = {}
    for node, pairs in margins.items():
        name = re.sub(r"\[.*", "", node.split("::")[1]).removeprefix("test_")
        worst[name] = max([*pairs, *([worst[name]] if name in worst else [])], key=lambda pair: pair[0] / pair[1])
    rows = [f"| `{name}` | {seen:.2g} | {bound:.3g} |" for name, (seen, bound) in worst.items()]
    return "\n".join([BEGIN, "| test | seen, nearest to its bound | bound |", "|---|---|---|", *rows, END])


def with_table(readme: str, margins: Margins) -> str:
    """The README with its table made anew."""
    return re.sub(f"{re.escape(BEGIN)}.*{re.escape(END)}", lambda _: table(margins), readme, flags=re.S)


def main(files: Iterable[str] = FILES) -> int:
    """Run the tests, keep the margins and rewrite the table; the exit status of pytest."""
    recorder = Recorder()
    status = pytest.main(["-q", *(str(HERE / name) for name in files)], plugins=[Named(recorder)])
    kept = dict(sorted({**recorded(), **recorder.margins}.items()))
    MARGINS.write_text(json.dumps(kept, indent=0) + "\n", encoding="utf-8")
    README.write_text(with_table(README.read_text(encoding="utf-8"), kept), encoding="utf-8")
    return int(status)


class Named:
    """Registers a recorder under its name, which the fixture asks for."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder

    def pytest_configure(self, config: pytest.Config) -> None:
        """Register it."""
        config.pluginmanager.register(self._recorder, RECORDER)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or FILES))
