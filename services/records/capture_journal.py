"""Journal of captures in progress, written before their exposure: after a power cut it lists the captures to repeat."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from device import atomic_io
from device.values import EYES, Eye
from services.errors import RecordNotFound, StoreDamaged
from services.records import digested_json, row_validation
from services.records.capture_store import CaptureStore
from services.records.json_values import JsonObject
from services.records.record_document import whole_number
from services.records.storage_errors import storage_errors

WITHOUT_KEY = frozenset({"id", "eye", "visit", "slot", "tries"})  # entries of earlier releases
WITHOUT_DIGEST = WITHOUT_KEY | {"key"}


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


class CaptureJournal:
    """Journal with one small file per capture in progress.

    Entries that exist at the opening belong to interrupted captures and are in `interrupted`; an entry whose capture is
    in the store is deleted instead. Captures that the store quarantined at its opening are in `interrupted` also
    without an entry, then with id and eye only. An entry without a visit is reported in one run only: `mark_reported`.
    """

    def __init__(self, store: CaptureStore) -> None:
        self._folder = store.folder / "underway"
        with storage_errors():
            atomic_io.make_folder(self._folder)
            paths = sorted(self._folder.glob("*.json"))
            found, self._keys = {path.stem: _read(path) for path in paths}, {path.stem: _key(path) for path in paths}
        for id in [id for id in found if _is_kept(store, id)]:
            del found[id]
            self.end(id)
        for name in store.newly_quarantined:
            if not any(name.startswith(id) for id in found):
                found[name] = InterruptedCapture(name, _eye_in(name))
        self.interrupted = tuple(found.values())

    def begin(self, press: InterruptedCapture, key: str | None = None) -> None:
        """Write the journal entry of the capture `press`, with the idempotency key of its request; durable on return.

        Errors: StoreFull, StoreError.
        """
        with storage_errors():
            content = digested_json.encoded(asdict(press) | {"key": key})
            atomic_io.write_file(self._folder / f"{press.id}.json", content)
            atomic_io.fsync_folder(self._folder)

    def end(self, id: str, key: str | None = None) -> None:
        """Delete the entry of a capture that is stored, has failed, or whose interruption was handled.

        With `key`, also discard the interrupted captures with that idempotency key: the request now has its picture.
        StoreError if the disk refuses.
        """
        with storage_errors():
            (self._folder / f"{id}.json").unlink(missing_ok=True)
        if key is not None:
            self.discard(lambda one: self._keys.get(one.id) == key)

    def discard(self, is_handled: Callable[[InterruptedCapture], bool]) -> None:
        """Remove the captures for which `is_handled` is true from `interrupted`, and delete their entries."""
        discarded = [one for one in self.interrupted if is_handled(one)]
        for one in discarded:
            self.end(one.id)
        self.interrupted = tuple(one for one in self.interrupted if one not in discarded)

    def mark_reported(self) -> None:
        """Delete the entries of interrupted test pictures, which were reported; they stay in `interrupted` in this run.

        A picture of a visit keeps its entry until it is repeated or the visit is finished. StoreError if the disk
        refuses.
        """
        for one in self.interrupted:
            if one.visit is None:
                self.end(one.id)


def _is_kept(store: CaptureStore, id: str) -> bool:
    with suppress(StoreDamaged):
        try:
            store.get(id)
        except RecordNotFound:
            return False
    return True


def _read(path: Path) -> InterruptedCapture:
    """Return the interrupted capture in an entry; with id and eye only if the entry is incomplete or has changed."""
    try:
        entry = _entries(path)
        eye = row_validation.one_of(entry["eye"], *EYES, None)
        visit, slot = (None if entry[name] is None else row_validation.text(entry[name]) for name in ("visit", "slot"))
        return InterruptedCapture(path.stem, eye, visit, slot, whole_number(entry["tries"]))
    except (ValueError, KeyError, TypeError):
        return InterruptedCapture(path.stem, _eye_in(path.stem))


def _key(path: Path) -> str | None:
    """Return the idempotency key in a journal entry; None without one, or if the entry cannot be read."""
    try:
        key = _entries(path).get("key")
    except ValueError:
        return None
    return key if isinstance(key, str) else None


def _entries(path: Path) -> JsonObject:
    """Return the entries of a journal file; ValueError if it is incomplete or has changed."""
    content = path.read_bytes()
    with suppress(ValueError):
        return digested_json.decoded(content, WITHOUT_DIGEST)
    return digested_json.decoded(content, WITHOUT_KEY)


def _eye_in(name: str) -> Eye | None:
    """Return the eye (OD or OS) that a capture id contains; None if it contains none."""
    return next((eye for eye in EYES if f"-{eye}-" in name), None)
