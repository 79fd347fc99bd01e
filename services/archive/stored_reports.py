"""Figures of the report that the instrument stored with a capture: the state before a reprocessing run."""

import json
from pathlib import Path


def earlier_figures(path: str) -> dict[str, object]:
    """Return the dose and the columns `before_...` but `before_picture` of the table from the stored report at `path`.

    Empty for an empty path, and for a report that is missing or damaged.
    """
    if not path:
        return {}
    try:
        report = json.loads(Path(path).read_bytes())
    except (OSError, ValueError):
        return {}
    parts = {key: report.get(key) for key in ("quality", "refraction_dpt", "verdict", "seconds")}
    quality, dpt, verdict, seconds = (one if isinstance(one, dict) else {} for one in parts.values())
    return {
        "before_method": report.get("method"),
        "before_residual": report.get("residual"),
        "before_cutoff_per_px": quality.get("cutoff_per_px"),
        "before_structure_sure": quality.get("structure_sure"),
        "before_sphere_dpt": dpt.get("sphere"),
        "before_verdict": verdict.get("word"),
        "before_cause": verdict.get("code"),
        "dose_j_per_cm2": report.get("dose_j_per_cm2"),
        "before_seconds": sum(one for one in seconds.values() if isinstance(one, float)) or None,
    }
