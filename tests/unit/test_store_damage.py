"""Damaged store, a small sample of tests/hard: no change of one file loses or changes anything silently."""

from pathlib import Path

import pytest

from tests.store_damage import expected, filled_store, plan, run_trial

SAMPLE = 40


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Path]:
    """Return a store that was closed, and a copy of an open one, whose last rows are in the write-ahead log."""
    folder = tmp_path_factory.mktemp("stores")
    return {with_log: filled_store(folder / f"{with_log}", with_log=with_log) for with_log in (False, True)}


def test_no_damage_of_one_file_is_silent(stores: dict[bool, Path], tmp_path: Path) -> None:
    before = {with_log: expected(store, with_settings=True) for with_log, store in stores.items()}
    every = plan(20 * SAMPLE)
    trials = [run_trial(stores, before, trial, tmp_path) for trial in every[:: len(every) // SAMPLE]]
    assert len(trials) >= SAMPLE
    assert not [trial for trial in trials if trial.violations]
