"""What a power cut took: known by the notes of presses under way."""

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from device.values import Capture
from services.records.store import Store
from services.records.underway import Lost, Underway


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store(tmp_path, reserve_bytes=0) as store:
        yield store


def test_a_kept_press_is_not_lost_and_a_torn_note_still_names_its_eye(store: Store) -> None:
    folder = store.folder / "underway"
    Underway(store).begin(Lost("20260301T120000-OS-ab", "OS", "v", "L-nerve", 1))
    (folder / "20260301T120001-OD-cd.json").write_bytes(b"{half")
    kept = Capture("20260301T120002-OD-ef", "OD", datetime(2026, 3, 1, tzinfo=UTC), True, "00ff", {}, {})
    Underway(store).begin(Lost(kept.id, "OD"))
    store.keep(kept, {"raw.tiff": b"1"})
    found = Underway(store)
    assert found.lost == (
        Lost("20260301T120000-OS-ab", "OS", "v", "L-nerve", 1), Lost("20260301T120001-OD-cd", "OD"),
    )  # fmt: skip
    assert not (folder / f"{kept.id}.json").exists()
    found.forget(lambda one: one.eye == "OS")
    assert [one.eye for one in Underway(store).lost] == ["OD"]
