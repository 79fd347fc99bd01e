"""Damaged store: bit flips, truncations, zeroed blocks, removals, swaps and lost rows over every file of a store.

`python -m tests.hard.test_store_damage` prints the table that stands in services/records/README.md.
"""

import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import pytest

from tests.store_damage import Planned, Trial, expected, filled_store, plan, run_trial, table

TRIALS = 1_250
FLIPS, OTHERS = 1_000, 200


def run_all(folder: Path, trials: int) -> list[Trial]:
    """Run the planned trials in two processes, each on a copy of one of two stores in `folder`."""
    stores = {with_log: filled_store(folder / f"{with_log}", with_log=with_log) for with_log in (False, True)}
    before = {with_log: expected(store, with_settings=True) for with_log, store in stores.items()}
    scratch = folder / "scratch"
    scratch.mkdir()
    planned: list[Planned] = plan(trials)
    with ProcessPoolExecutor(2) as pool:
        return list(pool.map(partial(run_trial, stores, before, scratch=scratch), planned, chunksize=20))


@pytest.mark.timeout(900)  # a quarter of an hour, for 1,250 openings beside other tests
def test_no_damage_of_one_file_is_silent(tmp_path: Path) -> None:
    trials = run_all(tmp_path, TRIALS)
    assert not [trial for trial in trials if trial.violations]
    assert sum(trial.damage == "bit" for trial in trials) >= FLIPS
    assert sum(trial.damage != "bit" for trial in trials) >= OTHERS


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        sys.stdout.write(table(run_all(Path(scratch), TRIALS)) + "\n")
