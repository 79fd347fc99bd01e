"""Figures of the report that the instrument stored with a capture: the state before a reprocessing run."""

from pathlib import Path

from device.errors import StoreError
from services.archive.source_files import source_content
from services.records.capture import CaptureReport


def earlier_figures(path: str) -> dict[str, object]:
    """Return the dose and the columns `before_...` but `before_picture` of the table from the stored report at `path`.

    Empty for an empty path, and for a report that is missing or damaged.
    """
    if not path:
        return {}
    try:
        report = CaptureReport.parse(source_content(Path(path)).decode())
    except (OSError, StoreError, ValueError):
        return {}
    verdict = report.verdict
    return {
        "before_method": report.method,
        "before_residual": report.residual,
        "before_cutoff_per_px": report.quality.get("cutoff_per_px"),
        "before_structure_sure": report.quality.get("structure_sure"),
        "before_sphere_dpt": (report.refraction_dpt or {}).get("sphere"),
        "before_verdict": verdict and verdict.word,
        "before_cause": verdict and verdict.code,
        "dose_j_per_cm2": report.dose_j_per_cm2,
        "before_seconds": report.from_read_out_s,
    }
