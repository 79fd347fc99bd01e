"""What a capture is made of on the shelf: its raw and dark frames, its pictures, its report."""

import json
from dataclasses import asdict
from typing import Any

import numpy as np

from device.errors import DiffuscopeError
from device.recon.verdict import Verdict
from device.values import Capture, Frame, Image, Reconstruction, Report
from services.instrument.press import Exposed
from services.records import picture

QUICK_PX = 640
UNMADE = "none"  # in place of the method, in the report of a shot whose picture could not be made


def capture_files(
    capture: Capture, head: str, frame: Frame, dark: Frame, shown: Image, quick: bytes | None
) -> dict[str, bytes]:
    """Every file of a capture by its name; `shown` is the linear picture that people look at, `quick` its first JPEG.

    The frames hold all it takes to make the picture again.
    """
    facts = {
        "id": capture.id, "eye": capture.eye, "taken_at": capture.taken_at.isoformat(),
        "exposure_s": frame.exposure_s, "glow": asdict(frame.glow) if frame.glow else None,
        "simulated": frame.simulated, "calibration_id": capture.calibration_id, "head": head,
    }  # fmt: skip
    return {
        "raw.tiff": picture.raw_tiff(frame.counts, facts),
        "dark.tiff": picture.raw_tiff(dark.counts, facts | {"glow": None}),
        "picture.png": picture.to_png(shown, capture.simulated, f"{capture.eye} {capture.taken_at:%Y-%m-%d}"),
        "quick.jpg": quick or picture.to_jpeg(shown, QUICK_PX, capture.simulated),
        "report.json": as_json(capture.report | {"simulated": capture.simulated}),
    }


def report_of(
    shot: Exposed, made: Report, verdict: Verdict, laterality: dict[str, Any] | None, budget_s: float
) -> dict[str, Any]:
    """The report of a picture that was made within `budget_s`, as it will be read back: lists for tuples, no numpy."""
    judged = {"verdict": asdict(verdict), "laterality": laterality, "budget_s": budget_s}
    errand = shot.press.errand
    report = asdict(made) | shot.light | errand.facts | {"test": errand.is_test} | judged
    plain: dict[str, Any] = json.loads(as_json(report | {"seconds": {"expose": shot.expose_s, **made.seconds}}))
    return plain


def unmade(frame: Frame, error: DiffuscopeError) -> Reconstruction:
    """What is kept of a shot whose picture could not be made: the frame itself, as the sensor saw it, and why."""
    report = Report(method=UNMADE, rounds=0, stopped=error.code, warnings=(error.message,))
    return Reconstruction(frame.counts.astype(np.float32), report, frame.simulated)


def as_json(data: dict[str, Any]) -> bytes:
    """JSON for a file; numpy's numbers become plain ones."""
    return json.dumps(data, indent=1, default=_plain).encode()


def _plain(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value)} does not belong into a report")
