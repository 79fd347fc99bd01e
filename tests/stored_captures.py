"""Stores of the instrument with captures of given frames."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from device.clock import VirtualClock
from services.imaging.picture_files import raw_tiff
from services.imaging.raw_metadata import RawMetadata
from services.records import blobs
from services.records.capture import Capture, CaptureReport, RecordOrigin
from services.records.capture_store import CaptureStore
from services.records.patient_keys import PatientKeys


def kept_content(path: Path) -> bytes:
    """Return the plain content of a file of a capture in a store without a key; the store is not changed."""
    return blobs.read_file(path, PatientKeys(path.parents[2], None, readonly=True))


def write_store(
    folder: Path,
    raw: NDArray[np.uint16],
    calibration_id: str,
    names: tuple[str, ...],
    device: RecordOrigin | None = None,
) -> None:
    """Add captures to a store, each with a little more light than the one before, and with a dark frame."""
    with CaptureStore(folder, reserve_bytes=0) as store:
        for k, name in enumerate(names):
            taken_at = VirtualClock().wall()
            capture = Capture(name, "OD", taken_at, True, calibration_id, CaptureReport(device=device), {})
            metadata = RawMetadata(
                id=name,
                eye="OD",
                taken_at=taken_at,
                exposure_s=0.1,
                illumination=None,
                simulated=True,
                calibration_id=calibration_id,
                head="tiny",
            )
            lit, dark = raw_tiff(raw + np.uint16(k), metadata), raw_tiff(raw // 100, metadata)
            store.save(capture, {"raw.tiff": lit, "dark.tiff": dark, "report.json": b"{}", "picture.png": b""})
