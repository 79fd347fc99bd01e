"""Report of a capture: whatever JSON a release stored is returned by the writer, and the columns agree with it."""

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing, suppress
from datetime import UTC, datetime
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.records.capture import Capture, CaptureReport, EyeConfirmation, EyeCorrection
from services.records.capture_store import CaptureStore

# Keys of the reports of each release on `main`, with a value as that release wrote it.
SOLVER = {
    "method": "variation",
    "bin": 1,
    "rounds": 12,
    "stopped": "done",
    "seconds": {"expose": 0.2, "solve": 0.5},
    "psf_index": 0,
    "psf_scale": 1.0,
    "refraction_dpt": {"sphere": -1.25, "sd": 0.5},
    "regularisation": {"tau": 1e-3},
    "noise_dn": 9.5,
    "residual": 0.84,
    "quality": {"coverage": 0.98, "resolution_um": None},
    "warnings": ["dim"],
}
LIGHT = {
    "dose_j_per_cm2": 9.9e-6,
    "dose_24h_j_per_cm2": {"OD": 9.9e-6, "OS": 0},
    "dose_stop_j_per_cm2": 0.1584,
    "dose_high": [],
}
VISIT = {"visit": "20260302T120000-ddeeba", "slot": "R-centre"}
VERDICT = {"verdict": {"word": "again", "code": "shot.moved", "numbers": {"smear": 0.4339, "residual": None}}}
LATERALITY = {"test": False, "laterality": {"eye": "OS", "confidence": 0.99, "disc": [10.5, 20]}, "budget_s": 5.0}
CORRECTED = {
    "moved": [{"from_eye": "OS", "from_slot": "L-centre", "eye": "OD", "at": "2026-03-02T12:16:00+00:00", "by": None}],
    "confirmed": {"eye": "OD", "at": "2026-03-02T12:17:00+00:00", "by": "tablet 2"},
}
FRAMES = {
    "frames": [{"index": 0, "used": True, "shift_px": [0.0, 0.0], "weight": 1.0, "reason": None}],
    "channels": [{"name": "red", "shift_px": None, "predicted": False, "reason": "no PSF in red light"}],
}
ORIGIN = {
    "device": {
        "uuid": "5cfb0f4e-7a59-4c36-9d8b-6f4c6f1a2b3c",
        "serial": "10000000a1b2c3d4",
        "software": "0.2.0",
        "head": "Simulated head",
        "calibration_id": "81d7eff650299a58",
        "calibrated_at": None,
        "clock": "not_set",
    },
}
FIGURES = (
    "sphere",
    "sd",
    "j0",
    "j0_sd",
    "j45",
    "j45_sd",
    "sphere_sc",
    "cylinder",
    "axis_deg",
    "field_deg",
    "field_deg_sd",
)
CYLINDER = {"refraction_dpt": dict.fromkeys(FIGURES, -1.25) | {"zero": "point source", "refused": None}}
WARPED = {
    "psf_cylinder": {"j0_dpt": -1.0, "j45_dpt": 0.25, "gain_db": None},
    "refraction_scatter": {"frames": 4, "sd_dpt": 0.05, "stated_sd_dpt": 0.04, "chi2": 4.6875},
}
BALANCED = {
    "channels": [
        {"name": "red", "shift_px": [0.5, -1.0], "predicted": False, "reason": None, "white_ratio": 0.056},
        {"name": "blue", "shift_px": None, "predicted": True, "reason": None},
    ],
}
REFUSED = {"refraction_dpt": dict.fromkeys(FIGURES) | {"refused": "no structure"}}
RELEASES: list[dict[str, Any]] = [
    SOLVER,
    SOLVER | LIGHT,
    SOLVER | LIGHT | VISIT,
    SOLVER | LIGHT | VISIT | VERDICT,
    SOLVER | LIGHT | VISIT | VERDICT | LATERALITY,
    SOLVER | LIGHT | VISIT | VERDICT | LATERALITY | CORRECTED,
    SOLVER | LIGHT | VISIT | VERDICT | LATERALITY | CORRECTED | FRAMES | REFUSED,
    SOLVER | LIGHT | VISIT | VERDICT | LATERALITY | CORRECTED | FRAMES | ORIGIN | CYLINDER,
    SOLVER | LIGHT | VISIT | VERDICT | LATERALITY | CORRECTED | FRAMES | ORIGIN | CYLINDER | WARPED | BALANCED,
]
KEYS = sorted(RELEASES[-1])

texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
numbers = st.integers(-(2**53), 2**53) | st.floats(allow_nan=False, allow_infinity=False)
values = st.recursive(
    st.none() | st.booleans() | numbers | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=6,
)
unknown = st.dictionaries(texts, values, max_size=3)


@st.composite
def stored_reports(draw: st.DrawFn) -> dict[str, Any]:
    """Return the report of a release, without some keys, with unknown ones, and with some values of any type."""
    report = dict(draw(st.sampled_from(RELEASES)))
    for name in draw(st.sets(st.sampled_from(KEYS), max_size=4)):
        report.pop(name, None)
    for name in draw(st.sets(st.sampled_from(KEYS), max_size=2)):
        report[name] = draw(values)
    for name in ("verdict", "laterality"):
        if isinstance(report.get(name), dict):
            report[name] = report[name] | draw(unknown)
    return draw(unknown) | report


def same(left: object, right: object) -> bool:
    """Return whether two values are the same JSON; 1, 1.0 and true differ."""
    return json.dumps(left, sort_keys=True) == json.dumps(right, sort_keys=True)


@given(stored_reports())
def test_the_writer_returns_every_stored_entry(stored: dict[str, Any]) -> None:
    try:
        report = CaptureReport.read(stored)
    except (ValueError, KeyError):
        return  # an entry on which the program acts has a wrong type: a damaged record, whose text stays as it is
    written = report.as_json()
    assert {name: value for name, value in stored.items() if not same(written.get(name), value)} == {}
    assert CaptureReport.read(written) == report
    assert same(CaptureReport.read(written).as_json(), written)


@given(values)
def test_any_json_is_read_or_refused_as_a_damaged_record(stored: Any) -> None:
    with suppress(ValueError, KeyError):
        CaptureReport.read(stored)


@pytest.mark.parametrize("stored", RELEASES)
def test_the_report_of_each_release_is_read_and_missing_entries_have_their_default(stored: dict[str, Any]) -> None:
    report, default = CaptureReport.read(stored), CaptureReport()
    assert report.others == {}
    assert report.method == "variation"
    assert (report.visit, report.test) == (stored.get("visit"), "visit" not in stored)
    assert (report.verdict is None) == ("verdict" not in stored)
    if "laterality" not in stored:
        assert (report.laterality, report.budget_s) == (default.laterality, default.budget_s)
    assert (report.moved != (), report.confirmed is not None) == ("moved" in stored, "confirmed" in stored)
    assert (report.device is not None) == ("device" in stored)


def test_an_empty_report_has_every_default_and_no_correction() -> None:
    assert CaptureReport.read({}) == CaptureReport()
    assert set(CaptureReport().as_json()) == set(KEYS) - set(CORRECTED) - set(FRAMES) - set(ORIGIN) - set(WARPED)


@given(stored_reports(), st.sampled_from(["R-nerve", "L-nerve"]))
def test_a_correction_changes_slot_and_moves_only(stored: dict[str, Any], slot: str) -> None:
    try:
        before = CaptureReport.read(stored)
    except (ValueError, KeyError):
        return
    move = EyeCorrection("OD", "R-centre", "OS", "2026-03-02T12:16:00+00:00", "tablet 1")
    written, earlier = before.with_correction(slot, move).as_json(), before.as_json()
    assert written["slot"] == slot
    moved = written["moved"]
    assert isinstance(moved, list)
    assert same(moved[:-1], earlier.get("moved") or [])
    assert CaptureReport.read(written).moved == (*before.moved, move)
    other = {name: value for name, value in written.items() if name not in ("slot", "moved")}
    assert same(other, {name: value for name, value in earlier.items() if name not in ("slot", "moved")})
    confirmed = before.with_confirmation(EyeConfirmation("OD")).as_json()
    assert confirmed["confirmed"] == {"eye": "OD", "at": None, "by": None}


@given(st.dictionaries(texts, numbers, max_size=3), st.integers(0, 100), st.booleans())
def test_what_is_built_is_read_again(seconds: dict[str, float], rounds: int, test: bool) -> None:
    built = CaptureReport(
        "evidence",
        rounds=rounds,
        seconds=seconds,
        warnings=("dim",),
        visit=None if test else "v",
        slot=None if test else "R-centre",
        moved=(EyeCorrection("OS", "L-centre", "OD"),),
    )
    assert CaptureReport.read(json.loads(json.dumps(built.as_json()))) == built


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Iterator[sqlite3.Connection]:
    """Return a connection to the tables of a store with one capture."""
    folder = tmp_path_factory.mktemp("columns")
    with CaptureStore(folder, reserve_bytes=0) as store:
        taken = Capture("c", "OD", datetime(2026, 3, 1, tzinfo=UTC), True, "00ff", CaptureReport(), {})
        store.save(taken, {"raw.tiff": b"raw"})
    with closing(sqlite3.connect(folder / "store.sqlite", isolation_level=None)) as connection:
        connection.execute("BEGIN")
        yield connection


@given(stored_reports())
@settings(deadline=None)
def test_the_columns_are_the_entries_of_the_report(tables: sqlite3.Connection, stored: dict[str, Any]) -> None:
    tables.execute("UPDATE captures SET report = ?", (json.dumps(stored),))
    (row,) = tables.execute("SELECT visit, slot, verdict, laterality FROM captures").fetchall()
    for name, kind, column in zip(("visit", "slot", "verdict", "laterality"), (str, str, dict, dict), row, strict=True):
        entry = stored.get(name)
        if not isinstance(entry, kind):
            assert column is None
        elif kind is str:
            assert column == entry
        else:
            assert json.loads(column) == entry
