"""The README's table equals the recorded margins, and every margin belongs to an existing test."""

import ast

from tests.hard.figures import FILES, HERE, README, recorded, with_table


def test_the_readme_table_equals_the_recorded_margins() -> None:
    readme = README.read_text(encoding="utf-8")
    assert readme == with_table(readme, recorded()), "run python -m tests.hard.figures"


def test_every_test_with_a_bound_has_a_margin_and_every_margin_a_test() -> None:
    trees = {name: ast.parse((HERE / name).read_text(encoding="utf-8")) for name in FILES}
    tests = {
        f"tests/hard/{name}::{node.name}"
        for name, tree in trees.items()
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and "within" in [arg.arg for arg in node.args.args]
    }
    assert {node.split("[")[0] for node in recorded()} == tests
