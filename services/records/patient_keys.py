"""Keys of the patients of a store: what identifies a patient, and all pictures, are on the disk only under such a key.

    patient-keys, patient-keys-copy    slots of 128 bytes: patient id, wrapped key, SHA-256 of both

Each key is 32 random bytes, wrapped (AES-256-GCM) by a key that HKDF derives from the store's key. A slot is written in
place, first in one file and then in the other: a kill leaves one whole copy, and no older file has an erased key. The
first file is the newer one; a slot that is damaged in it is read from the other, and healed at the next opening. An
erased slot keeps its patient id. Without a store's key the wrapping key is derived from zeros: keys can be erased, but
a copy of the folder can be read; the first opening with a key wraps them again.
"""

import hashlib
import os
import struct
from collections.abc import Iterable
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from device import atomic_io
from services.errors import RecordErased, StoreDamaged
from services.records.record_files import new_key

FILES = ("patient-keys", "patient-keys-copy")
DEVICE = ""  # in the place of a patient id: the key of pictures without a visit
KEY_BYTES, NONCE_BYTES = 32, 12
_CONTENT = struct.Struct("36s60s")  # NUL bytes fill up the id; wrapped: nonce, key, tag of 16 bytes
_ERASED = bytes(60)
SLOT_BYTES = _CONTENT.size + 32
Slot = tuple[str, bytes]  # patient id and wrapped key


class PatientKeys:
    """Keys of the patients of the store in `folder`, wrapped by its `key`; OSError if the disk refuses. Thread-safe.

    Opening heals what is damaged in one copy. Other processes may use the same files. With `readonly` nothing is
    written.
    """

    def __init__(self, folder: Path, key: bytes | None, readonly: bool = False) -> None:
        self._paths = [folder / name for name in FILES]
        self._wrapping = _wrapping(key)
        self._places = dict[str, int]()  # of the slots, by patient id; replaced as a whole
        self._erased, self._read_at = frozenset[str](), list[int]()
        if readonly:
            self._read_places()
            return
        for path in self._paths:
            open(path, "ab", opener=atomic_io.private_opener).close()
        atomic_io.fsync_folder(folder)
        with atomic_io.file_lock(self._paths[0]):
            self._heal(wrap_again=key is not None and new_key(folder, key) is not None)
        self.create(DEVICE)

    @property
    def erased(self) -> frozenset[str]:
        """Ids of the patients whose key is erased; the files are read again if any process has changed one."""
        if self._changed_at() != self._read_at:
            self._read_places()
        return self._erased

    def create(self, patient_id: str) -> None:
        """Make the key of a patient (id of at most 36 bytes), durable in both files; no effect if there was one."""
        with atomic_io.file_lock(self._paths[0]):
            places = self._read_places()
            if patient_id not in places:
                place = max(path.stat().st_size for path in self._paths) // SLOT_BYTES
                wrapped = _sealed(self._wrapping, os.urandom(KEY_BYTES), "key", patient_id)
                _write(self._paths, place, (patient_id, wrapped))
                self._places = places | {patient_id: place}

    def erase(self, patient_id: str) -> None:
        """Overwrite the key of a patient in both files, durably; no effect if there is none."""
        with atomic_io.file_lock(self._paths[0]):
            place = self._read_places().get(patient_id)
            if place is not None:
                _write(self._paths, place, (patient_id, _ERASED))
                self._read_places()

    def encrypt(self, patient_id: str, content: bytes, purpose: str) -> bytes:
        """Return nonce, encrypted content and tag, 28 bytes more; `decrypt` needs that `purpose` and has the errors."""
        return _sealed(self._cipher(patient_id), content, purpose, patient_id)

    def decrypt(self, patient_id: str, content: bytes, purpose: str) -> bytes:
        """Return what was encrypted; RecordErased if the key was erased, StoreDamaged if key or content are damaged."""
        return _opened(self._cipher(patient_id), content, purpose, patient_id)

    def _cipher(self, patient_id: str) -> AESGCM:
        """Return the cipher of a patient. The slot is read at each call: another process may have erased the key."""
        places = self._places
        for _ in range(2):
            for path in filter(Path.exists, self._paths) if patient_id in places else ():
                with path.open("rb", buffering=0) as file:
                    slot = _parsed(os.pread(file.fileno(), SLOT_BYTES, places[patient_id] * SLOT_BYTES))
                if slot == (patient_id, _ERASED):
                    raise RecordErased("the key of this patient was erased")
                if slot is not None and slot[0] == patient_id:
                    return AESGCM(_opened(self._wrapping, slot[1], "key", patient_id))
            places = self._read_places()  # another process may have made the key
        raise StoreDamaged(f"the key of the patient {patient_id!r:.60} is missing or damaged")

    def _changed_at(self) -> list[int]:
        return [path.stat().st_mtime_ns for path in self._paths if path.exists()]

    def _read_places(self) -> dict[str, int]:
        self._read_at = self._changed_at()
        slots = _merged(*map(_slots_in, self._paths))
        self._places = {slot[0]: place for place, slot in enumerate(slots) if slot is not None}
        self._erased = frozenset(slot[0] for slot in slots if slot is not None and slot[1] == _ERASED)
        return self._places

    def _heal(self, wrap_again: bool) -> None:
        """Write each slot that is whole in one file only to the other; cut off what is whole in none of them."""
        copies = [_slots_in(path) for path in self._paths]
        slots = _merged(*copies)
        for path, copy in zip(self._paths, copies, strict=True):
            for place, (slot, present) in enumerate(zip_longest(slots, copy[: len(slots)])):
                if slot is not None and slot != present:
                    _write([path], place, slot)
            os.truncate(path, len(slots) * SLOT_BYTES)
        for place, slot in enumerate(slots if wrap_again else ()):
            with suppress(StoreDamaged):  # erased, or wrapped by an earlier opening, which was interrupted
                patient_id, wrapped = slot or (DEVICE, b"")
                key = _opened(_wrapping(None), wrapped, "key", patient_id)
                _write(self._paths, place, (patient_id, _sealed(self._wrapping, key, "key", patient_id)))
        self._read_places()


def ids_in_files(folder: Path) -> list[set[str]]:
    """Return the patient ids of the whole slots of each file; nothing is changed. OSError if one cannot be read."""
    return [{slot[0] for slot in _slots_in(folder / name) if slot is not None} for name in FILES]


def _wrapping(key: bytes | None) -> AESGCM:
    return AESGCM(HKDF(SHA256(), KEY_BYTES, salt=None, info=b"keys of patients").derive(key or bytes(KEY_BYTES)))


def _sealed(cipher: AESGCM, content: bytes, purpose: str, patient_id: str) -> bytes:
    """Return nonce and encrypted content; the associated data bind it to its purpose and patient."""
    nonce = os.urandom(NONCE_BYTES)
    return nonce + cipher.encrypt(nonce, content, f"{purpose}\0{patient_id}".encode())


def _opened(cipher: AESGCM, content: bytes, purpose: str, patient_id: str) -> bytes:
    try:
        return cipher.decrypt(content[:NONCE_BYTES], content[NONCE_BYTES:], f"{purpose}\0{patient_id}".encode())
    except (InvalidTag, ValueError) as error:
        raise StoreDamaged("encrypted content has changed, or belongs to another key") from error


def _parsed(slot: bytes) -> Slot | None:
    """Return patient id and wrapped key of a slot; None if it is damaged or empty."""
    content, digest = slot[: _CONTENT.size], slot[_CONTENT.size :]
    if len(digest) < 32 or hashlib.sha256(content).digest() != digest:
        return None
    name, wrapped = _CONTENT.unpack(content)
    return name.rstrip(b"\0").decode(), wrapped


def _slots_in(path: Path) -> list[Slot | None]:
    """Return the slots of a file, without an incomplete last one; none of a missing file."""
    content = path.read_bytes() if path.exists() else b""
    starts = range(0, len(content) - SLOT_BYTES + 1, SLOT_BYTES)
    return [_parsed(content[start : start + SLOT_BYTES]) for start in starts]


def _merged(first: list[Slot | None], second: list[Slot | None]) -> list[Slot | None]:
    """Return each slot as the first copy that has it whole; None where none has, but not beyond the shorter copy."""
    slots = [left or right for left, right in zip_longest(first, second)]
    while len(slots) > min(len(first), len(second)) and slots[-1] is None:
        slots.pop()
    return slots


def _write(paths: Iterable[Path], place: int, slot: Slot) -> None:
    """Overwrite one slot in each file, durable in one before the next."""
    content = _CONTENT.pack(slot[0].encode(), slot[1])
    for path in paths:
        atomic_io.overwrite(path, content + hashlib.sha256(content).digest(), place * SLOT_BYTES)
