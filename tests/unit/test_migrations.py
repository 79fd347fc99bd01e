"""Captures outlive versions: a migration only adds, so that the version before reads what the next one wrote."""

import ast
from collections.abc import Iterator

import pytest

from tests.house import files, nodes, text

TAKES_AWAY = {
    "drop_table",
    "drop_column",
    "drop_constraint",
    "drop_index",
    "alter_column",
    "rename_table",
    "batch_alter_table",
}
MIGRATIONS = [name for name in files() if name.startswith("services/records/migrations/versions/r")]


def taken_away(source: str) -> Iterator[str]:
    """What an upgrade does that an older release would trip over; SQL by hand counts if it drops or renames."""
    upgrades = [node for node in nodes(source) if isinstance(node, ast.FunctionDef) and node.name == "upgrade"]
    for node in (inner for upgrade in upgrades for inner in ast.walk(upgrade)):
        if isinstance(node, ast.Attribute) and node.attr in TAKES_AWAY:
            yield node.attr
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield from (word for word in ("DROP ", "RENAME ", "DELETE ", "UPDATE ") if word in node.value.upper())


@pytest.mark.parametrize("name", MIGRATIONS)
def test_a_migration_only_adds(name: str) -> None:
    assert not list(taken_away(text(name)))


def test_what_takes_away_would_be_noticed() -> None:
    assert list(taken_away("def upgrade():\n    op.drop_column('captures', 'eye')")) == ["drop_column"]
    assert list(taken_away("def upgrade():\n    op.execute('drop table captures')")) == ["DROP "]
    assert len(MIGRATIONS) >= 2
