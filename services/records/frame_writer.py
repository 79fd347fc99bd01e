"""Frames of a press on the disk from their read-out on, so that a kill of the process loses no frame that was taken.

    journal/<id>/dark.tiff, raw.tiff, raw-1.tiff, ..., raw-red.tiff    frames in the order of exposure
    journal/<id>/<name>.json                                           note of one frame: SHA-256, length, dose

The frames are encrypted as the files of captures are. The note is written after its frame: a frame without a note, or
with another SHA-256 than in its note, does not count. The store links the files into the folder of the capture
(`blobs.write_folder`), so each frame is written once; there `raw.tiff` is the first frame that can be used.
"""

import hashlib
import logging
import re
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from device import atomic_io
from device.errors import DiffuscopeError, FrameError, StoreError
from device.user_files import files_in
from device.values import Frame
from services.imaging import picture_files
from services.imaging.raw_metadata import RawMetadata
from services.records import blobs, digested_json
from services.records.blobs import WrittenFile
from services.records.json_values import JsonObject
from services.records.patient_keys import PatientKeys

log = logging.getLogger(__name__)

DARK, FIRST = "dark.tiff", "raw.tiff"
_LIT = re.compile(r"raw(-[0-9]+)?\.tiff")


@dataclass(frozen=True)
class TakenFrame:
    """Frame of a press right after its read-out.

    `name`: name of its file. `dose_j_per_cm2`, `exposed_s`: dose of the press, and time since its begin, until now.
    """

    name: str
    frame: Frame
    metadata: RawMetadata
    dose_j_per_cm2: float
    exposed_s: float


@dataclass(frozen=True)
class StoredFrame:
    """Frame of an interrupted press on the disk: file, number of the frame, dose and time as in `TakenFrame`."""

    file: WrittenFile
    number: int
    dose_j_per_cm2: float
    exposed_s: float
    keys: PatientKeys = field(repr=False, compare=False)

    @property
    def is_lit(self) -> bool:
        """Whether it is a frame of the burst: neither the dark frame nor one in another colour of light."""
        return _LIT.fullmatch(self.file.path.name) is not None

    def load(self) -> tuple[Frame, RawMetadata]:
        """Return the frame and its metadata; OSError, StoreError or FrameError if the file cannot be read."""
        counts, metadata = picture_files.read_raw_tiff(blobs.read_file(self.file.path, self.keys))
        if metadata.exposure_s is None or metadata.simulated is None:
            raise FrameError(f"{self.file.path.name} has no exposure time, or no mark of its origin")
        light = metadata.illumination
        simulated = metadata.simulated
        return Frame(counts, metadata.exposure_s, self.number, light, simulated), metadata


class FrameWriter:
    """Writer of the frames of one press into `folder`, in a thread of its own; the exposure does not wait for the disk.

    `encrypt` returns the content of a file as it is on the disk.
    One thread calls `write`; `finish` and `close` may be called from any. The frames that wait are those of one press,
    which are in memory anyway, and one encoded frame more. After an error of the disk nothing more is written: the
    press goes on with its frames in memory.
    """

    def __init__(self, folder: Path, encrypt: Callable[[bytes], bytes]) -> None:
        self._folder, self._encrypt = folder, encrypt
        self._executor = ThreadPoolExecutor(1, "frames")  # starts its thread with the first frame
        self._written: dict[int, Future[WrittenFile | None]] = {}
        self._has_failed = False

    def write(self, taken: TakenFrame) -> None:
        """Begin to write a frame; return at once."""
        self._written[taken.frame.number] = self._executor.submit(self._write, taken)

    def finish(self) -> Mapping[int, WrittenFile]:
        """Wait until every frame is written or has failed; return the files by the number of their frame."""
        files = {number: future.result() for number, future in self._written.items()}
        return {number: file for number, file in files.items() if file is not None}

    def close(self, *, complete: bool = False) -> None:
        """Wait until every frame is written, with `complete`; else only for the one that is being written."""
        self._executor.shutdown(cancel_futures=not complete)

    def _write(self, taken: TakenFrame) -> WrittenFile | None:
        """Write a frame and then its note, durably; None after an error of the disk, which is logged once."""
        if self._has_failed:
            return None
        path = self._folder / taken.name
        note = path.with_name(f"{path.name}.json")
        try:
            atomic_io.make_folder(self._folder)
            content = picture_files.raw_tiff(taken.frame.counts, taken.metadata)
            stored = self._encrypt(content)
            file = WrittenFile(path, hashlib.sha256(content).hexdigest(), len(stored))
            atomic_io.write_file(path, stored)
            atomic_io.write_file(note, digested_json.encoded(_note_of(file, taken)))
            atomic_io.fsync_folder(self._folder)
        except (OSError, DiffuscopeError) as error:
            self._has_failed = True
            log.warning("the frames stay in memory until the capture is stored: %s", error)
            with suppress(OSError):  # without its note the frame does not count
                note.unlink(missing_ok=True)
                path.unlink(missing_ok=True)
            return None
        return file


def stored_frames(folder: Path, keys: PatientKeys) -> tuple[StoredFrame, ...]:
    """Return the whole frames in the folder of an interrupted press, in the order of their exposure.

    A frame that is incomplete, changed, erased or without a note is left out, with a line in the log. Empty without a
    folder.
    """
    found = []
    for note in files_in(folder, "*.tiff.json"):
        try:
            found.append(_checked(folder / note.stem, digested_json.decoded(note.read_bytes()), keys))
        except (OSError, StoreError, ValueError, KeyError, TypeError) as error:
            log.warning("%s of the interrupted capture %s is left out: %s", note.stem, folder.name, error)
    return tuple(sorted(found, key=lambda frame: frame.number))


def _note_of(file: WrittenFile, taken: TakenFrame) -> JsonObject:
    return {
        "file_sha256": file.sha256,
        "length_bytes": file.length_bytes,
        "number": taken.frame.number,
        "dose_j_per_cm2": taken.dose_j_per_cm2,
        "exposed_s": taken.exposed_s,
    }


def _checked(path: Path, note: JsonObject, keys: PatientKeys) -> StoredFrame:
    """Return the frame of a note; ValueError if its file is not the one that was written, or as `blobs.read_file`."""
    content = blobs.read_file(path, keys)
    file = WrittenFile(path, hashlib.sha256(content).hexdigest(), path.stat().st_size)
    if (file.sha256, file.length_bytes) != (note["file_sha256"], note["length_bytes"]):
        raise ValueError(f"{file.length_bytes} bytes that are not those of its note")
    number, dose_j_per_cm2, exposed_s = (note[name] for name in ("number", "dose_j_per_cm2", "exposed_s"))
    if not isinstance(number, int) or not isinstance(dose_j_per_cm2, float) or not isinstance(exposed_s, float):
        raise TypeError("its note has values of other types")
    return StoredFrame(file, number, dose_j_per_cm2, exposed_s, keys)
