"""The pages of the keys of head files and scenes are those of the models, and name every key of the shipped files."""

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from services import resources
from services.research.key_reference import PAGES, SITE

SHIPPED = [*sorted(resources.HEADS.glob("*.toml")), *sorted(resources.SCENES.glob("*.toml"))]


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_that_of_the_models(name: str) -> None:
    assert (SITE / name).read_text(encoding="utf-8") == PAGES[name](), (
        ".venv/bin/python -m services.research.key_reference"
    )


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_key_of_a_shipped_file_stands_on_a_page(path: Path) -> None:
    rows = {name: page().splitlines() for name, page in PAGES.items()}
    for table, key in keys(tomllib.loads(path.read_text(encoding="utf-8")), ""):
        page = rows["scene_keys.md" if table.startswith("sim") else "head_keys.md"]
        heading = f"## `[{table}]`" if table else "## At the top"
        if heading not in page:
            assert "colours" in table, table  # tables whose names are colours
            continue
        section = page[page.index(heading) + 1 :]
        end = next((k for k, line in enumerate(section) if line.startswith("## ")), len(section))
        assert any(line.startswith(f"| `{key}` |") for line in section[:end]), f"{table}.{key}"


def test_the_kinds_of_objects_stand_on_the_page_of_scenes() -> None:
    assert '"image"' in next(line for line in PAGES["scene_keys.md"]().splitlines() if line.startswith("| `kind` |"))


def keys(table: dict[str, Any], path: str) -> Iterator[tuple[str, str]]:
    """Yield (table, key) of every value of a TOML file."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from keys(value, f"{path}.{key}".lstrip("."))
        else:
            yield path, key
