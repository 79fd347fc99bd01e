"""Content of the files of a source: those of a store are encrypted under the keys of its patients."""

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from device.errors import FrameError
from device.values import Image
from services.imaging.picture_files import read_png
from services.research.montage_files import read_picture

if TYPE_CHECKING:
    from services.records.patient_keys import PatientKeys


def source_content(path: Path) -> bytes:
    """Return the plain content of a file of a source, which may be a store with its keys.

    OSError if it cannot be read; of a store RecordErased, or StoreDamaged if it has changed or its key is missing.
    """
    if not _is_stored(path):
        return path.read_bytes()
    from services.records import blobs  # deferred: of the extra `instrument`

    return blobs.read_file(path, _keys(path.parents[2]))


def earlier_picture(path: Path) -> Image:
    """Return an earlier picture as linear float32; FrameError or StoreError if it cannot be read."""
    try:
        return read_png(source_content(path)) if _is_stored(path) else read_picture(path)
    except OSError as error:
        raise FrameError(f"{path} cannot be read: {error.strerror}", "Give the source again.") from error


def _is_stored(path: Path) -> bool:
    """Return whether a file is that of a capture in a store."""
    return path.parent.parent.name == "captures" and (path.parents[2] / "patient-keys").exists()


@cache
def _keys(store: Path) -> "PatientKeys":
    from services.identity.audit_key import find_audit_key
    from services.records.patient_keys import PatientKeys

    return PatientKeys(store, find_audit_key(store), readonly=True)
