"""Journal of captures in progress, written before their exposure, with the frames that were taken.

    journal/<id>.json       entry of one capture in progress
    journal/<id>/           its frames, until the capture is stored or has failed (frame_writer.py)

After a kill or a power cut it lists the captures whose frames are reconstructed, and the captures to repeat.
"""

import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from device import atomic_io
from device.errors import StoreError
from device.user_files import files_in
from device.values import EYES, Eye
from services.errors import RecordNotFound, StoreDamaged
from services.records import blobs, digested_json, row_validation
from services.records.capture import OtherColour
from services.records.capture_store import CaptureStore
from services.records.capture_target import FRAMES, OTHER_COLOURS
from services.records.frame_writer import FrameWriter, StoredFrame, stored_frames
from services.records.json_values import JsonObject
from services.records.patient_rows import patient_of_visit
from services.records.record_document import whole_number
from services.records.storage_errors import storage_errors

JOURNAL = "journal"  # folder in the store
MAX_ATTEMPTS = 2  # starts that try to reconstruct the frames of a capture: they may be what ends the process
_ATTEMPT = "attempt-{}"
_Plan = tuple[int, tuple[OtherColour, ...]]  # number of frames in the picture's colour, other colours


@dataclass(frozen=True)
class InterruptedCapture:
    """A capture that is in progress, or was interrupted before its request was answered.

    `id`: capture id; `visit` and `slot`: None for a test picture; `tries`: number of earlier captures of that slot.
    """

    id: str
    eye: Eye | None
    visit: str | None = None
    slot: str | None = None
    tries: int = 0


@dataclass(frozen=True)
class ResumableCapture:
    """An interrupted capture with at least one lit frame on the disk.

    `press`: its entry; `key`: idempotency key of its request. `planned`: number of frames in the picture's colour that
    were to be taken, the parts of split exposures counted. `colours`: other colours of light that were to be taken.
    `frames`: what is on the disk, in order of exposure.
    """

    press: InterruptedCapture
    key: str | None
    planned: int
    colours: tuple[OtherColour, ...]
    frames: tuple[StoredFrame, ...]


class CaptureJournal:
    """Journal with one small file, and a folder of frames, per capture in progress.

    Entries that exist at the opening belong to interrupted captures; an entry whose capture is in the store is deleted
    instead, with its frames. A readable entry with a lit frame is in `resumable`, until `end`, `fail` or MAX_ATTEMPTS.
    The others are in `interrupted`, as are captures that the store quarantined at its opening, which have only id and
    eye without an entry.
    An entry without a visit is reported in one run only: `mark_reported`. In a read-only store nothing is resumed.
    """

    def __init__(self, store: CaptureStore) -> None:
        self._store, self._folder = store, store.folder / JOURNAL
        self._writers: dict[str, FrameWriter] = {}
        self.resumable: tuple[ResumableCapture, ...] = ()
        with storage_errors():
            atomic_io.make_folder(self._folder)
            entries = {path.stem: _entry(path) for path in files_in(self._folder, "*.json")}
        found = {id: _capture(id, entry) for id, entry in entries.items()}
        self._keys = {id: _key(entry) for id, entry in entries.items()}
        for id in [id for id in found if _is_kept(store, id)]:
            del found[id]
            self.end(id)
        for name in store.newly_quarantined:
            if not any(name.startswith(id) for id in found):
                found[name] = InterruptedCapture(name, _eye_in(name))
        if store.refusal is None:
            self._remove_strays()
            kept = ((found[id], _plan(entry)) for id, entry in entries.items() if id in found)
            self.resumable = tuple(resumed for press, plan in kept if (resumed := self._resumable(press, plan)))
        resumable = {capture.press.id for capture in self.resumable}
        self.interrupted = tuple(press for id, press in found.items() if id not in resumable)

    def begin(
        self,
        press: InterruptedCapture,
        key: str | None = None,
        planned: int = FRAMES,
        colours: Sequence[OtherColour] = (),
    ) -> FrameWriter:
        """Write the journal entry of the capture `press`, durable on return; return the writer of its frames.

        `key`: idempotency key of its request; `planned`, `colours`: as in `ResumableCapture`. Errors: StoreFull,
        StoreError, RecordNotFound for an unknown visit.
        """
        patient_id = patient_of_visit(self._store.engine, press.visit)
        encrypt = partial(blobs.encrypted, self._store.keys, patient_id)
        with storage_errors():
            entry = asdict(press) | {"key": key, "planned": planned, "colours": list(colours)}
            atomic_io.write_file(self._folder / f"{press.id}.json", digested_json.encoded(entry))
            atomic_io.fsync_folder(self._folder)
        writer = self._writers[press.id] = FrameWriter(self._folder / press.id, encrypt)
        return writer

    def count_attempt(self, id: str) -> None:
        """Count one more attempt to reconstruct the frames of an interrupted capture, durably, before it begins.

        After MAX_ATTEMPTS that the process did not survive, the frames are given up. Errors: StoreFull, StoreError.
        """
        folder = self._folder / id
        with storage_errors():
            atomic_io.write_file(folder / _ATTEMPT.format(_attempts(folder) + 1), b"")
            atomic_io.fsync_folder(folder)

    def end(self, id: str, key: str | None = None) -> None:
        """Delete the entry and the frames of a capture that is stored or given up, or was handled.

        With `key`, also discard the interrupted captures with that idempotency key: the request now has its picture.
        StoreError if the disk refuses.
        """
        with storage_errors():
            (self._folder / f"{id}.json").unlink(missing_ok=True)
        self.resumable = tuple(capture for capture in self.resumable if capture.press.id != id)
        self._remove_frames(id)
        if key is not None:
            self.discard(lambda press: self._keys.get(press.id) == key)

    def fail(self, id: str) -> None:
        """Delete the frames and the entry of a capture that has failed; one that was resumed keeps its entry.

        It is in `interrupted` from then on.

        StoreError if the disk refuses.
        """
        resumed = next((capture.press for capture in self.resumable if capture.press.id == id), None)
        if resumed is None:
            self.end(id)
            return
        self.resumable = tuple(capture for capture in self.resumable if capture.press.id != id)
        self.interrupted = (*self.interrupted, resumed)
        self._remove_frames(id)

    def postpone(self, id: str) -> bool:
        """Keep the frames of a capture that the store refused, for the next start; True if at least one is lit.

        Without a lit frame on the disk, as `fail`. The attempt does not count. StoreError if the disk refuses.
        """
        folder = self._folder / id
        if (writer := self._writers.pop(id, None)) is not None:
            writer.close(complete=True)
        if not any(frame.is_lit for frame in stored_frames(folder, self._store.keys)):
            self.fail(id)
            return False
        with storage_errors():
            for attempt in folder.glob(_ATTEMPT.format("*")):
                attempt.unlink()
        return True

    def discard(self, is_handled: Callable[[InterruptedCapture], bool]) -> None:
        """Remove the captures for which `is_handled` is true from `interrupted`, and delete their entries."""
        discarded = [press for press in self.interrupted if is_handled(press)]
        for handled in discarded:
            self.end(handled.id)
        self.interrupted = tuple(press for press in self.interrupted if press not in discarded)

    def mark_reported(self) -> None:
        """Delete the entries of interrupted test pictures, which were reported; they stay in `interrupted` in this run.

        A picture of a visit keeps its entry until it is repeated or the visit is finished. StoreError if the disk
        refuses.
        """
        for press in self.interrupted:
            if press.visit is None:
                self.end(press.id)

    def close(self) -> None:
        """Wait until the frames of captures that are still in progress are on the disk, for the next opening."""
        for writer in self._writers.values():
            writer.close(complete=True)

    def _resumable(self, press: InterruptedCapture, plan: _Plan | None) -> ResumableCapture | None:
        """Return an interrupted capture with its frames; `plan`: what was to be taken.

        None, and its frames are deleted, without a lit one, without a readable entry or after MAX_ATTEMPTS.
        """
        folder = self._folder / press.id
        frames = stored_frames(folder, self._store.keys)
        if plan is None or not any(frame.is_lit for frame in frames) or _attempts(folder) >= MAX_ATTEMPTS:
            with suppress(StoreError):  # then the next opening deletes them
                self._remove_frames(press.id)
            return None
        return ResumableCapture(press, self._keys[press.id], *plan, frames)

    def _remove_strays(self) -> None:
        """Delete folders of frames without an entry: their capture was stored or has failed."""
        for folder in self._folder.iterdir():
            if folder.is_dir() and folder.name not in self._keys:
                with suppress(StoreError):  # then the next opening deletes them
                    self._remove_frames(folder.name)

    def _remove_frames(self, id: str) -> None:
        """End the writing of the frames of a capture, and delete them."""
        if (writer := self._writers.pop(id, None)) is not None:
            writer.close()
        with storage_errors(), suppress(FileNotFoundError):
            shutil.rmtree(self._folder / id)


def _is_kept(store: CaptureStore, id: str) -> bool:
    with suppress(StoreDamaged):
        try:
            store.get(id)
        except RecordNotFound:
            return False
    return True


def _capture(id: str, entry: JsonObject) -> InterruptedCapture:
    """Return the interrupted capture of an entry; with id and eye only if the entry has no valid content."""
    try:
        eye = row_validation.one_of(entry["eye"], *EYES, None)
        visit, slot = (None if entry[name] is None else row_validation.text(entry[name]) for name in ("visit", "slot"))
        return InterruptedCapture(id, eye, visit, slot, whole_number(entry["tries"]))
    except (ValueError, KeyError, TypeError):
        return InterruptedCapture(id, _eye_in(id))


def _key(entry: JsonObject) -> str | None:
    """Return the idempotency key in an entry; None without one."""
    key = entry.get("key")
    return key if isinstance(key, str) else None


def _plan(entry: JsonObject) -> _Plan | None:
    """Return the plan in an entry; None without one."""
    try:
        colours = entry["colours"]
        named = colours if isinstance(colours, list) else []
        return whole_number(entry["planned"]), tuple(colour for colour in OTHER_COLOURS if colour in named)
    except (ValueError, KeyError):
        return None


def _attempts(folder: Path) -> int:
    return len(list(folder.glob(_ATTEMPT.format("*"))))


def _entry(path: Path) -> JsonObject:
    """Return the content of a journal file; an empty entry if it is incomplete or has changed."""
    try:
        return digested_json.decoded(path.read_bytes())
    except ValueError:
        return {}


def _eye_in(name: str) -> Eye | None:
    """Return the eye (OD or OS) that a capture id contains; None if it contains none."""
    return next((eye for eye in EYES if f"-{eye}-" in name), None)
