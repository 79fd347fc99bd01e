"""The README's table is the one that the recorded margins make, and every margin belongs to a test that exists."""

import ast

from tests.hard.figures import FILES, HERE, README, recorded, with_table


def test_the_readme_holds_the_recorded_figures() -> None:
    said = README.read_text(encoding="utf-8")
    assert said == with_table(said, recorded()), "run python -m tests.hard.figures"


def test_every_margin_is_of_a_test_that_exists_and_every_test_with_a_bound_has_one() -> None:
    of_file = {name: ast.parse((HERE / name).read_text(encoding="utf-8")) for name in FILES}
    tests = {
        f"tests/hard/{name}::{node.name}"
        for name, tree in of_file.items()
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and "within" in [arg.arg for arg in node.args.args]
    }
    assert {node.split("[")[0] for node in recorded()} == tests
