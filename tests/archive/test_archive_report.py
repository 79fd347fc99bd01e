"""The page about a large table, and figures of a table with every state."""

import re
import time
from base64 import b64decode
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from device.config.marked_files import stated_in, tiff_bytes
from services.archive.report import write_report
from services.archive.table import age_days, encoded_table

ROWS, MAX_S = 100_000, 30.0


def synthetic_rows(count: int) -> list[dict[str, object]]:
    """Return rows of a store: two heads, calibrations of up to a year, one of twenty captures in quarantine."""
    rng = np.random.default_rng(0)
    cutoff, gain, age = rng.uniform(0.05, 0.2, count), rng.normal(1.05, 0.05, count), rng.uniform(0, 365, count)
    rows: list[dict[str, object]] = []
    for k in range(count):
        row: dict[str, object] = {"id": f"c{k}", "state": "done", "device": f"head-{k % 2}", "method": "variation"}
        row |= {
            "before_cutoff_per_px": cutoff[k],
            "quality_cutoff_per_px": cutoff[k] * gain[k],
            "total_s": 0.5,
            "quality_psf_score": 1 - age[k] / 3650,
            "calibration_age_days": age[k],
            "solve_s": 0.4,
            "messages": [],
            "sphere_dpt": age[k] / 100 - 2,
            "sphere_sd_dpt": 0.2,
            "before_verdict": "again" if k % 7 == 0 else "good",
            "before_cause": "dark" if k % 7 == 0 else None,
            "worker": "tcp://10.0.0.1:1",
            "simulated": True,
        }
        rows.append({"id": f"c{k}", "state": "quarantine", "reason": "no signal"} if k % 20 == 19 else row)
    return rows


def test_a_table_of_a_hundred_thousand_rows_is_reported_in_time(tmp_path: Path) -> None:
    (tmp_path / "captures.parquet").write_bytes(encoded_table(synthetic_rows(ROWS)))
    begin_s = time.monotonic()
    words = write_report(tmp_path, tmp_path / "report.html", lambda _: None)
    assert time.monotonic() - begin_s < MAX_S
    assert f"{ROWS} captures, {ROWS - ROWS // 20} compared" in words
    page = (tmp_path / "report.html").read_text()
    assert len(page) < 5e6
    assert "head-0" in page
    assert "no signal" in page
    assert page.count("<h2>") == 10
    assert "c19, c39" in page  # the first captures of a reason


def test_an_archive_without_earlier_pictures_shows_what_is_least_explained(tmp_path: Path) -> None:
    rows = [{"id": f"c{k}", "state": "done", "residual": 1.0 + k, "messages": []} for k in range(8)]
    (tmp_path / "captures.parquet").write_bytes(encoded_table(rows))
    write_report(tmp_path, tmp_path / "report.html", lambda _: None)
    page = (tmp_path / "report.html").read_text()
    assert "Nothing to compare" in page
    assert "got worse" not in page
    assert page.index("c7: residual 8") < page.index("c6: residual 7")


@pytest.mark.parametrize("simulated", [True, False])
def test_pictures_are_marked_where_their_frames_are_simulated(tmp_path: Path, simulated: bool) -> None:
    picture = np.random.default_rng(0).uniform(0, 1, (90, 160)).astype(np.float32)
    (tmp_path / "picture.tiff").write_bytes(tiff_bytes(picture, simulated))
    row = {"id": "c", "state": "done", "residual": 1.0, "messages": [], "picture": "picture.tiff"}
    (tmp_path / "captures.parquet").write_bytes(encoded_table([row | {"simulated": simulated}]))
    write_report(tmp_path, tmp_path / "report.html", lambda _: None)
    (jpeg,) = re.findall(r"data:image/jpeg;base64,([^\"]+)", (tmp_path / "report.html").read_text())
    assert stated_in("x.jpg", BytesIO(b64decode(jpeg))) is simulated


def test_the_age_of_a_calibration_is_in_days_or_unknown() -> None:
    assert age_days("2026-01-01T00:00:00+00:00", "2026-01-03T12:00:00Z") == 2.5
    assert age_days("", "2026-01-03") is None
    assert age_days("yesterday", "2026-01-03") is None
