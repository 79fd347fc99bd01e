"""Fixtures of the tests of printed parts: meshes of the head and the model eye, and modified light paths."""

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest

if find_spec("build123d") is None:  # installed in .parts-venv only: `make test-parts`
    collect_ignore_glob = ["test_*.py"]
else:
    from hardware.parts import assembly
    from hardware.parts.dimensions import OPTICS, Dimensions, dimensions
    from hardware.parts.solids import Manifold, solid


@pytest.fixture(scope="session")
def d() -> "Dimensions":
    return dimensions()


@pytest.fixture(scope="session")
def head(d: "Dimensions") -> dict[str, "Manifold"]:
    return {name: solid(part) for name, part in assembly.head(d).items()}


@pytest.fixture(scope="session")
def eye(d: "Dimensions") -> dict[str, "Manifold"]:
    return {name: solid(part) for name, part in assembly.eye(d).items()}


@pytest.fixture
def changed(tmp_path: Path) -> Callable[[str, str], "Dimensions"]:
    """Return the dimensions of `optics.toml` with a line replaced: changed("iris_um = 3200", "iris_um = 1600")."""

    def change(was: str, becomes: str) -> "Dimensions":
        text = OPTICS.read_text(encoding="utf-8")
        assert text.count(was) == 1
        (file := tmp_path / "optics.toml").write_text(text.replace(was, becomes), encoding="utf-8")
        return dimensions(file)

    return change


@pytest.fixture(scope="session")
def chart_eye(d: "Dimensions") -> dict[str, "Manifold"]:
    return {name: solid(part) for name, part in assembly.chart_eye(d).items()}
