"""JSON records on disk, and a readable difference between a record and the present result."""

import difflib
import json
from pathlib import Path
from typing import Any

RECORDS = Path(__file__).parent / "records"
MAX_LINES = 60  # maximum length of a printed difference


def as_text(record: Any) -> str:
    """Return a record as indented JSON with sorted keys; lists and tuples of plain values stay on one line."""
    return "".join(_lines(record, 0)) + "\n"


def write(name: str, record: Any) -> None:
    """Write a record as `records/NAME.json`."""
    RECORDS.mkdir(exist_ok=True)
    (RECORDS / f"{name}.json").write_text(as_text(record), encoding="utf-8")


def read(name: str) -> Any:
    """Read `records/NAME.json`."""
    return json.loads((RECORDS / f"{name}.json").read_text(encoding="utf-8"))


def difference(recorded: Any, present: Any, tolerance: float = 0.0) -> str:
    """Return a unified diff of two records, at most MAX_LINES long; empty for equal records.

    Floating-point figures are equal if they differ by at most `tolerance` times the recorded one, or times 1.
    """
    present = _without_rounding(recorded, json.loads(json.dumps(present)), tolerance)
    texts = [as_text(value).splitlines() for value in (recorded, present)]
    lines = list(difflib.unified_diff(texts[0], texts[1], "recorded", "present", lineterm="", n=2))
    more = [f"... and {len(lines) - MAX_LINES} lines more"] if len(lines) > MAX_LINES else []
    return "\n".join(lines[:MAX_LINES] + more)


def _without_rounding(recorded: Any, present: Any, tolerance: float) -> Any:
    """Return `present` with the recorded figure wherever its own is equal within the tolerance."""
    if isinstance(recorded, dict) and isinstance(present, dict):
        return {key: _without_rounding(recorded.get(key), value, tolerance) for key, value in present.items()}
    if isinstance(recorded, list) and isinstance(present, list) and len(recorded) == len(present):
        return [_without_rounding(old, new, tolerance) for old, new in zip(recorded, present, strict=True)]
    if isinstance(recorded, float) and isinstance(present, float):
        return recorded if abs(present - recorded) <= tolerance * max(abs(recorded), 1.0) else present
    return present


def _lines(value: Any, depth: int) -> list[str]:
    """Return the pieces of a value's text; a value that fits on one line is not broken."""
    flat = json.dumps(value, ensure_ascii=False, sort_keys=True)
    if not isinstance(value, dict | list | tuple) or not value or len(flat) + depth <= 116:
        return [flat]
    pad, end = " " * (depth + 1), " " * depth
    if isinstance(value, dict):
        inner = [
            f"{pad}{json.dumps(str(key), ensure_ascii=False)}: {''.join(_lines(value[key], depth + 1))}"
            for key in sorted(value)
        ]
        return ["{\n", ",\n".join(inner), f"\n{end}}}"]
    inner = [f"{pad}{''.join(_lines(entry, depth + 1))}" for entry in value]
    return ["[\n", ",\n".join(inner), f"\n{end}]"]
