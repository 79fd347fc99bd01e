"""Consistency of the table of mutants with the present tree; `make test-mutants` runs the mutants."""

import ast

import pytest

from tests.golden.mutants import MUTANTS, ROOT, Mutant, mutated


@pytest.mark.parametrize("mutant", MUTANTS, ids=[f"{number}" for number in range(1, len(MUTANTS) + 1)])
def test_a_mutant_has_its_place_and_its_test(mutant: Mutant) -> None:
    ast.parse(mutated((ROOT / mutant.file).read_text(encoding="utf-8"), mutant))
    file, _, name = mutant.test.partition("::")
    assert f"def {name.partition('[')[0]}" in (ROOT / file).read_text(encoding="utf-8")
