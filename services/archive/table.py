"""Table of a run as Parquet: one row for each capture of the plan, for pandas, DuckDB and Spark.

`state` is `done` (has a result), `quarantine` (failed; `reason`, `reason_code`), `waiting` (not computed yet) or `left
out` (of the plan; `reason`). Units are in the names of the columns; `rows` and `cols` are in pixels, figures without a
unit as in `report.json`. `before_...` is of the picture and report as stored, the rest of this run.
"""

from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from io import BytesIO
from itertools import islice
from types import NoneType
from typing import get_args, get_type_hints

import pyarrow as pa
from pyarrow import parquet

from device import atomic_io
from device.values import Report
from services.archive.content import digest_of
from services.archive.plan import Plan, PlannedCapture
from services.archive.result import COLOUR_PICTURE, PICTURE, TABLE, Quarantined, ResultFolder, Stored
from services.archive.stored_reports import earlier_figures
from services.records.capture import CaptureReport
from services.research.report_schema import QUALITY

ROWS_PER_GROUP = 5_000
TEXT = pa.string()
NUMBER = pa.float64()
COUNT = pa.int64()
FLAG = pa.bool_()
TEXTS = pa.list_(pa.string())
# Entries of a report that are columns of the same name; their types are those of the record.
ENTRIES = ("method", "bin", "rounds", "stopped", "psf_index", "psf_scale", "noise_dn", "residual")
BEFORE = {
    "before_picture": TEXT,
    "before_method": TEXT,
    "before_residual": NUMBER,
    "before_cutoff_per_px": NUMBER,
    "before_structure_sure": NUMBER,
    "before_sphere_dpt": NUMBER,
    "before_verdict": TEXT,
    "before_cause": TEXT,
    "dose_j_per_cm2": NUMBER,
    "before_seconds": NUMBER,
}


def _column_type(entry: str) -> pa.DataType:
    """Return the type of the column of a report's entry that is a text or a number, or null."""
    hint = get_type_hints(Report)[entry]
    (kind,) = set(get_args(hint) or (hint,)) - {NoneType}
    return {str: TEXT, int: COUNT, float: NUMBER}[kind]


SCHEMA = pa.schema(
    {
        "id": TEXT,
        "state": TEXT,
        "reason": TEXT,
        "reason_code": TEXT,
        "source": TEXT,
        "raw": TEXT,
        "raw_sha256": TEXT,
        "result": TEXT,
        "picture": TEXT,
        "colour_picture": TEXT,
        "device": TEXT,
        "eye": TEXT,
        "taken_at": TEXT,
        "calibration": TEXT,
        "calibration_made_at": TEXT,
        "calibration_age_days": NUMBER,
        "simulated": FLAG,
        "rows": COUNT,
        "cols": COUNT,
        "exposure_s": NUMBER,
        "light_colour": TEXT,
        "light_level": NUMBER,
        "frames": COUNT,
        "frames_used": COUNT,
        "channels": TEXTS,
        "predicted_channels": TEXTS,
        "missing_channels": TEXTS,
        **{name: _column_type(name) for name in ENTRIES},
        **{f"quality_{name}": NUMBER for name in QUALITY},
        "sphere_dpt": NUMBER,
        "sphere_sd_dpt": NUMBER,
        "j0_dpt": NUMBER,
        "j45_dpt": NUMBER,
        "messages": TEXTS,
        "psnr_db": NUMBER,
        "pcc": NUMBER,
        "before_psnr_db": NUMBER,
        "before_pcc": NUMBER,
        **BEFORE,
        "solve_s": NUMBER,
        "total_s": NUMBER,
        "worker": TEXT,
        "finished_at": TEXT,
        "diffuscope": TEXT,
        "software": TEXT,
        "settings": TEXT,
    }
)
Row = dict[str, object]


def write_table(plan: Plan, results: ResultFolder) -> None:
    """Write `captures.parquet` atomically: captures with a result, in quarantine, left out, and not yet computed."""
    atomic_io.write_atomically(results.root / TABLE, encoded_table(_rows(plan, results)), mode=None)


def encoded_table(rows: Iterable[Row]) -> bytes:
    """Return rows with the columns of SCHEMA as a Parquet file, ROWS_PER_GROUP in memory at once."""
    out = BytesIO()
    waiting = iter(rows)
    with parquet.ParquetWriter(out, SCHEMA, compression="zstd") as writer:
        while group := list(islice(waiting, ROWS_PER_GROUP)):
            writer.write_table(pa.Table.from_pylist(group, SCHEMA))
    return out.getvalue()


def _rows(plan: Plan, results: ResultFolder) -> Iterator[Row]:
    failures = {failure.name: failure for failure in results.quarantined()}
    made_at = {calibration.digest: calibration.made_at for calibration in plan.calibrations}
    settings = digest_of(plan.settings.model_dump())[:12]
    common: Row = {"settings": settings, "diffuscope": plan.software["diffuscope"], "software": plan.software["code"]}
    for capture in plan.captures:
        row = common | planned_columns(capture, made_at[capture.calibration]) | earlier_figures(capture.report)
        if results.has(capture.result):
            yield row | _done_columns(results.read(capture.result), results, capture.result)
        else:
            yield row | _failed_columns(failures.get(capture.result))
    for left_out in plan.left_out:
        yield common | {
            "id": left_out.id,
            "source": left_out.source,
            "raw": left_out.raw,
            "state": "left out",
            "reason": left_out.reason,
        }


def planned_columns(capture: PlannedCapture, made_at: str) -> Row:
    """Return the columns that the plan knows; `made_at`: time of the calibration (ISO 8601), empty if unknown."""
    same = ("id", "source", "raw", "raw_sha256", "result", "device", "eye", "taken_at", "calibration")
    row: Row = {name: getattr(capture, name) or None for name in same}
    row["before_picture"] = capture.before or None
    return row | {"calibration_made_at": made_at or None, "calibration_age_days": age_days(made_at, capture.taken_at)}


def age_days(made_at: str, taken_at: str) -> float | None:
    """Return the days from the calibration to the capture (both ISO 8601); None if one of them is unknown."""
    if not (made_at and taken_at):
        return None
    try:
        first, second = (datetime.fromisoformat(text) for text in (made_at, taken_at))
    except ValueError:
        return None
    first, second = (time if time.tzinfo else time.replace(tzinfo=UTC) for time in (first, second))
    return (second - first).total_seconds() / 86400


def _failed_columns(failure: Quarantined | None) -> Row:
    if failure is None:
        return {"state": "waiting"}
    return {"state": "quarantine", "reason": failure.reason, "reason_code": failure.code}


def _done_columns(stored: Stored, results: ResultFolder, name: str) -> Row:
    """Return the columns of a stored result."""
    document = stored.report
    run = stored.run
    report = stored.reconstruction
    raw, scores, seconds = (
        _object(entry) for entry in (document.get("raw"), document.get("scores"), run.get("seconds"))
    )
    dpt = report.refraction_dpt or {}
    place = results.place(name)
    colour = place / COLOUR_PICTURE
    return {
        "state": "done",
        "picture": str((place / PICTURE).relative_to(results.root)),
        "colour_picture": str(colour.relative_to(results.root)) if colour.is_file() else None,
        **_frame_columns(report),
        "simulated": document.get("simulated"),
        "rows": document.get("rows"),
        "cols": document.get("cols"),
        "exposure_s": raw.get("exposure_s"),
        "light_colour": raw.get("colour"),
        "light_level": raw.get("light_level"),
        **{name: getattr(report, name) for name in ENTRIES},
        **{f"quality_{name}": report.quality.get(name) for name in QUALITY},
        "sphere_dpt": dpt.get("sphere"),
        "sphere_sd_dpt": dpt.get("sd"),
        "j0_dpt": dpt.get("j0"),
        "j45_dpt": dpt.get("j45"),
        "messages": list(report.warnings),
        **scores,
        "solve_s": seconds.get("solve"),
        "total_s": run.get("total_s"),
        "worker": run.get("worker"),
        "finished_at": run.get("finished_at"),
    }


def _frame_columns(report: CaptureReport) -> Row:
    """Return how many frames were taken and used, and the colours that are measured, predicted and missing."""
    taken = [channel for channel in report.channels if channel.reason is None]
    return {
        "frames": len(report.frames),
        "frames_used": sum(frame.used for frame in report.frames),
        "channels": [channel.name for channel in taken if not channel.predicted],
        "predicted_channels": [channel.name for channel in taken if channel.predicted],
        "missing_channels": [channel.name for channel in report.channels if channel.reason is not None],
    }


def _object(value: object) -> Mapping[str, object]:
    return value if isinstance(value, dict) else {}
