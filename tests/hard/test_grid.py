"""Reduced grid of hard cases through the default schedule, and the rules that must detect each kind of violation.

The whole grid is `make test-hard`.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from services.research.reconstruct_file import OutputFiles, reconstruct_file
from tests.hard.cases import CASES, CLEAN, NAMED
from tests.hard.cells import DEFAULT_SCHEDULE, PEER, CaseRunner, Cell
from tests.hard.frames import Eye
from tests.hard.grid import QUICK, QUICK_MERGED, run
from tests.hard.judgement import KINDS, LOST, covered, kind, lost, ratio, violations
from tests.hard.picture import draw_grid, table

EYE = Eye("relaxed eye, merged", "sim", {"sim.seed": 1}, merged=QUICK_MERGED)


@pytest.fixture(scope="module")
def grid(tmp_path_factory: pytest.TempPathFactory) -> CaseRunner:
    return CaseRunner(EYE, tmp_path_factory.mktemp("grid"), (DEFAULT_SCHEDULE,))


@pytest.fixture(scope="module")
def clean(grid: CaseRunner) -> list[Cell]:
    return grid.cells(CLEAN)


@pytest.mark.parametrize("key", QUICK)
def test_a_hard_case_keeps_its_bound_or_is_reported(
    key: str, grid: CaseRunner, clean: list[Cell], record_property: Callable[[str, object], None]
) -> None:
    cells = clean + grid.cells(NAMED[key])
    record_property("lost", str(cells[-1].lost))
    assert not [
        f"{violation.rule}: {violation.words}" for violation in violations(cells) if violation.rule != "coverage"
    ]


def test_the_grid_and_the_command_give_the_same_picture(grid: CaseRunner, clean: list[Cell], tmp_path: Path) -> None:
    """The grid keeps planned solvers, the command plans each time: both give the same picture and warnings."""
    raw, order, _ = grid.files(EYE.clean, DEFAULT_SCHEDULE)
    made = reconstruct_file(raw, order, OutputFiles(tmp_path / "picture.npy"))
    assert clean[0].pcc == pytest.approx(_pcc(np.load(tmp_path / "picture.npy")), abs=1e-4)
    assert made.report.warnings == clean[0].warnings
    assert clean[0].pcc > 0.95


def _pcc(picture: np.ndarray) -> float:
    take = EYE.clean.simulated
    return take.pcc(take.sampled(picture))


GOOD = Cell(
    "eye", CLEAN.key, DEFAULT_SCHEDULE, 0.95, 0.0, "", (), -1.0, 0.1, -1.0, {"coverage": 0.9, "resolution_um": 150.0}
)
OTHER = replace(GOOD, case="motion 0.5 deg")


@pytest.mark.parametrize(
    ("rule", "cell"),
    [
        ("crash", replace(OTHER, pcc=None, lost=None, refused="ZeroDivisionError", crashed=True)),
        ("hidden", replace(OTHER, case="rim cut", pcc=0.8, lost=0.15)),
        ("hidden", replace(OTHER, case="rim cut", pcc=float("nan"), lost=float("nan"))),
        ("refraction", replace(OTHER, sphere_dpt=-1.4)),
        ("refraction", replace(OTHER, true_dpt=None)),
        ("message", replace(OTHER, warnings=("This is not this head's PSF. Calibrate the head.",))),
        ("message", replace(OTHER, warnings=("Words that no rule knows.",))),
        ("quality", replace(OTHER, lost=0.06, quality={"coverage": 0.9, "resolution_um": 120.0})),
        ("coverage", replace(OTHER, sphere_dpt=-1.25)),
    ],
)
def test_each_kind_of_violation_is_detected(rule: str, cell: Cell) -> None:
    assert not violations([GOOD, OTHER])
    assert rule in [violation.rule for violation in violations([GOOD, cell])]


def test_a_refusal_and_a_reported_loss_are_no_violations() -> None:
    refused = replace(OTHER, pcc=None, lost=None, refused="Too bright", sphere_dpt=None, sd_dpt=None)
    explained = replace(OTHER, lost=0.2, quality={})
    assert not violations([GOOD, refused, explained])
    assert covered([GOOD, refused, explained]) == (1.0, 2)


def test_table_and_picture_hold_the_loss_over_the_allowed_one() -> None:
    worse = replace(OTHER, pcc=0.85, lost=2 * LOST, warnings=("The frame is banded.",))
    assert (ratio(GOOD), ratio(worse)) == (0, 2)
    assert (lost(replace(OTHER, lost=LOST)), lost(worse)) == (False, True)
    lines = table([GOOD, worse], (DEFAULT_SCHEDULE,)).splitlines()
    assert [line.split("|")[1:3] for line in lines[-3:]] == [
        [" **above 1** ", " 1 of 2 "],
        [" clean ", " 0.00 "],
        [" motion 0.5 deg ", " 2.00 "],
    ]
    drawn = draw_grid([GOOD, worse], [], "eye", (DEFAULT_SCHEDULE,), {"of_a_bound": (1.0, 4.0)})
    assert all(words in drawn for words in ("2.00 m", "of a bound", "0.25"))


def test_the_peer_is_drawn_and_not_judged() -> None:
    peer = replace(OTHER, method=PEER, pcc=0.1, lost=0.85)
    assert violations([GOOD, OTHER, peer]) == []
    assert "17.00" in draw_grid(
        [GOOD, replace(GOOD, method=PEER), OTHER, peer], [], "eye", (DEFAULT_SCHEDULE, PEER), {}
    )


def test_every_case_has_known_kinds_of_warnings() -> None:
    kinds = {name for name, _ in KINDS}
    assert len(NAMED) == len(CASES)
    assert all(case.true <= kinds for case in CASES)
    assert kind("The refraction of +1.0 dpt (sd 0.9) is uncertain.") == "refraction"


@pytest.mark.parametrize(("keys", "columns"), [(("no such case",), (DEFAULT_SCHEDULE,)), ((), ("no such method",))])
def test_unknown_cases_and_methods_are_refused(keys: tuple[str, ...], columns: tuple[str, ...]) -> None:
    from device.errors import SettingError

    with pytest.raises(SettingError, match="no such"):
        run((EYE,), keys, columns)
