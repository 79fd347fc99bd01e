"""Table of margins in the README: `python -m tests.hard.figures` runs the tests with bounds and records their figures.

Every call of `within` is stored in `margins.json`, by test; the README's table holds the worst of each test function.
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
FILES = ("test_bounds.py", "test_stability.py", "test_bursts.py")
RECORDER = "margins-recorder"
BEGIN, END = "<!-- margins: made by python -m tests.hard.figures -->", "<!-- end of margins -->"
Margins = Mapping[str, list[list[float]]]


class Recorder:
    """Pytest plugin that collects the margins of the tests."""

    def __init__(self) -> None:
        self.margins: dict[str, list[list[float]]] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Store the margins of a test that passed."""
        if report.when == "call" and report.passed:
            found = [value for name, value in report.user_properties if name == "margin"]
            if found:
                self.margins[report.nodeid] = found


@cache
def recorded() -> Margins:
    """Return the recorded (measured, bound) pairs of each test in order; empty without a record."""
    return json.loads(MARGINS.read_text(encoding="utf-8")) if MARGINS.exists() else {}


def worst_margins(margins: Margins) -> dict[str, tuple[float, float]]:
    """Return error and bound of each test function, those with the largest ratio."""
    worst: dict[str, tuple[float, float]] = {}
    for node, pairs in margins.items():
        name = re.sub(r"\[.*", "", node.split("::")[1]).removeprefix("test_")
        worst[name] = max([*pairs, *([worst[name]] if name in worst else [])], key=lambda pair: pair[0] / pair[1])
    return worst


def margins_table(margins: Margins) -> str:
    """Return the worst margin of each test function as Markdown: the error over its bound, and the bound."""
    rows = [
        f"| `{name}` | {seen / bound:.2f} | {bound:.3g} |" for name, (seen, bound) in worst_margins(margins).items()
    ]
    return "\n".join(["| test | error / bound, the largest | bound |", "|---|---|---|", *rows])


def with_table(readme: str, margins: Margins) -> str:
    """Return the README with its table replaced."""
    return re.sub(
        f"{re.escape(BEGIN)}.*{re.escape(END)}",
        lambda _: f"{BEGIN}\n{margins_table(margins)}\n{END}",
        readme,
        flags=re.S,
    )


def main(files: Iterable[str] = FILES) -> int:
    """Run the tests, store the margins and rewrite the table; return the exit status of pytest."""
    recorder = Recorder()
    status = pytest.main(["-q", *(str(HERE / name) for name in files)], plugins=[RecorderRegistration(recorder)])
    kept = dict(sorted({**recorded(), **recorder.margins}.items()))
    MARGINS.write_text(json.dumps(kept, indent=0) + "\n", encoding="utf-8")
    README.write_text(with_table(README.read_text(encoding="utf-8"), kept), encoding="utf-8")
    return int(status)


class RecorderRegistration:
    """Pytest plugin that registers a recorder under the name used by the fixture `within`."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder

    def pytest_configure(self, config: pytest.Config) -> None:
        """Register the recorder."""
        config.pluginmanager.register(self._recorder, RECORDER)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or FILES))
