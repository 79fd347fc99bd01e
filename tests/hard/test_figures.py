"""The README's table equals the recorded margins, and every margin belongs to an existing test."""

import ast
from dataclasses import replace

import pytest

from tests.bench.refraction import IMX296, Limits, Scored, cases, summarise, tabulate
from tests.hard import refraction_table
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


def test_the_table_of_the_refraction_holds_the_printed_groups(capsys: pytest.CaptureFixture[str]) -> None:
    case = next(cases(IMX296, 33.4, 1, 1))
    dim, refused = replace(case, light=0.2), replace(case, light=1.0)
    scored = [Scored(dim, (error_dpt, 0.0, 0.0), (0.1,) * 3, None) for error_dpt in (0.05, -0.15, 0.25)]
    tabulate([*scored, Scored(refused, (float("nan"),) * 3, (float("nan"),) * 3, "too dark")])
    summarise("imx296-33 M", scored, 0, Limits(0.2, 0.2))
    document = f"before\n{refraction_table.BEGIN}\nold\n{refraction_table.END}\nafter"
    made = refraction_table.with_table(document, capsys.readouterr().out).splitlines()
    assert (made[0], made[-1]) == ("before", "after")
    assert made[4:-2] == [
        "| imx296-33 | all | | 3 | 0% | 0.171 | 33% | 67% |",
        "| imx296-33 | light | 0.2 | 3 | 0 | 0.171 | 33% | 67% |",
        "| imx296-33 | light | 1 | 1 | 1 | - | - | - |",
        f"| imx296-33 | object | {case.photo} | 4 | 1 | 0.171 | 33% | 67% |",
    ]
    text = refraction_table.CASES.read_text(encoding="utf-8")
    assert refraction_table.BEGIN in text
    assert refraction_table.END in text
