"""Keys of the patients of a store: what identifies a patient, and all pictures, are on the disk only under such a key.

    patient-keys, patient-keys-copy    slots of 128 bytes: MAGIC, patient id, wrapped key, SHA-256 of these

Each key is 32 random bytes, wrapped (AES-256-GCM) by a key that HKDF derives from the store's key. A slot is written in
place, first in one file and then in the other, so that a kill leaves one whole copy, and an erased key is on no older
page of a file. The first file is the newer one; a slot that is damaged in it is read from the other, and healed at the
next opening. An erased slot keeps its patient id. Without a store's key the wrapping key is derived from zeros: keys
can be erased, but a copy of the folder can be read; the first opening with a key wraps them again.
"""

import hashlib
import struct
from itertools import zip_longest
from os import fsync, urandom
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
_MAGIC = b"pk1\0"
_CONTENT = struct.Struct("4s32s60s")  # NUL bytes fill up the id; wrapped: nonce, key, tag of 16 bytes
_ERASED = bytes(60)
SLOT_BYTES = _CONTENT.size + 32


class PatientKeys:
    """Keys of the patients of the store in `folder`, wrapped by the store's `key`; None: by a key that is public.

    Opening heals what is damaged in one copy, and makes the key of the device. Thread-safe; other processes may use the
    same files. With `readonly` nothing is written: keys are only read. `erased`: ids of the patients whose key this
    process found or made erased. OSError if the disk refuses.
    """

    def __init__(self, folder: Path, key: bytes | None, readonly: bool = False) -> None:
        self._paths = [folder / name for name in FILES]
        self._wrapping = _wrapping(key)
        self._places = dict[str, int]()  # of the slots, by patient id; replaced as a whole
        self._size = 0  # of the files, in slots, when the places were read
        self.erased = frozenset[str]()  # ids of the patients whose key was erased, when the places were read
        if readonly:
            self._read_places()
            return
        for path in self._paths:
            open(path, "ab", opener=atomic_io.private_opener).close()
        atomic_io.fsync_folder(folder)
        with atomic_io.file_lock(self._paths[0]):
            self._heal()
            if key is not None and new_key(folder, key) is not None:
                self._wrap_again()
        self.create(DEVICE)

    def create(self, patient_id: str) -> None:
        """Make the key of a patient, durable in both files; no effect if it exists or was erased.

        ValueError for an id of more than 32 bytes.
        """
        with atomic_io.file_lock(self._paths[0]):
            if self._slots_in_files() != self._size:
                self._read_places()
            if patient_id not in self._places:
                self._write(self._size, _slot(patient_id, self._wrapped(patient_id, urandom(KEY_BYTES))))
                self._places = self._places | {patient_id: self._size}
                self._size += 1

    def erase(self, patient_id: str) -> None:
        """Overwrite the key of a patient in both files, durably; no effect if there is none."""
        with atomic_io.file_lock(self._paths[0]):
            self._read_places()
            if patient_id in self._places:
                self._write(self._places[patient_id], _slot(patient_id, _ERASED))
                self._read_places()

    def encrypt(self, patient_id: str, content: bytes, purpose: str) -> bytes:
        """Return a random nonce of 12 bytes and the encrypted content with its tag of 16 bytes.

        `purpose`: what the content is, which `decrypt` must be given too. Errors: RecordErased, StoreDamaged.
        """
        nonce = urandom(NONCE_BYTES)
        return nonce + self._cipher(patient_id).encrypt(nonce, content, _context(purpose, patient_id))

    def decrypt(self, patient_id: str, content: bytes, purpose: str) -> bytes:
        """Return the content that `encrypt` was given with that patient and purpose.

        RecordErased if the key was erased; StoreDamaged if it is missing or damaged, or if the content has changed.
        """
        return _opened(self._cipher(patient_id), content, _context(purpose, patient_id))

    def _cipher(self, patient_id: str) -> AESGCM:
        """Return the cipher of a patient. The slot is read at each call: another process may have erased the key."""
        wrapped = self._read(patient_id)
        if wrapped is None:
            self._read_places()  # another process may have made the key
            wrapped = self._read(patient_id)
        if wrapped is None:
            raise StoreDamaged(f"the key of the patient {patient_id!r:.60} is missing or damaged")
        if wrapped == _ERASED:
            raise RecordErased("the key of this patient was erased")
        return AESGCM(_opened(self._wrapping, wrapped, _context("key", patient_id)))

    def _read(self, patient_id: str) -> bytes | None:
        place = self._places.get(patient_id)
        for path in filter(Path.exists, self._paths) if place is not None else ():
            with path.open("rb", buffering=0) as file:
                file.seek((place or 0) * SLOT_BYTES)
                found = _parsed(file.read(SLOT_BYTES))
            if found is not None and found[0] == patient_id:
                return found[1]
        return None

    def _wrapped(self, patient_id: str, key: bytes) -> bytes:
        nonce = urandom(NONCE_BYTES)
        return nonce + self._wrapping.encrypt(nonce, key, _context("key", patient_id))

    def _slots_in_files(self) -> int:
        return max(path.stat().st_size if path.exists() else 0 for path in self._paths) // SLOT_BYTES

    def _read_places(self) -> None:
        slots = _merged(*map(_slots_of, self._paths))
        parsed = [None if slot is None else _parsed(slot) for slot in slots]
        self._places = {found[0]: place for place, found in enumerate(parsed) if found is not None}
        self.erased = frozenset(found[0] for found in parsed if found is not None and found[1] == _ERASED)
        self._size = self._slots_in_files()

    def _write(self, place: int, slot: bytes) -> None:
        for path in self._paths:
            _write_slot(path, place, slot)

    def _heal(self) -> None:
        """Write each slot that is whole in one file only to the other; cut off what is whole in none of them."""
        copies = [_slots_of(path) for path in self._paths]
        slots = _merged(*copies)
        for path, copy in zip(self._paths, copies, strict=True):
            for place, (slot, present) in enumerate(zip_longest(slots, copy[: len(slots)])):
                if slot is not None and slot != present:
                    _write_slot(path, place, slot)
            if path.stat().st_size > len(slots) * SLOT_BYTES:
                with path.open("r+b") as file:
                    file.truncate(len(slots) * SLOT_BYTES)
        self._read_places()

    def _wrap_again(self) -> None:
        """Wrap with the store's key what was wrapped without one; the records are not noted to have a key yet."""
        public = _wrapping(None)
        for patient_id, place in self._places.items():
            wrapped = self._read(patient_id)
            if wrapped is None or wrapped == _ERASED:
                continue
            try:
                key = _opened(public, wrapped, _context("key", patient_id))
            except StoreDamaged:  # wrapped by a store's key: an earlier opening was interrupted
                continue
            self._write(place, _slot(patient_id, self._wrapped(patient_id, key)))


def ids_in_files(folder: Path) -> list[set[str]]:
    """Return the patient ids of the whole slots of each file; nothing is changed. OSError if one cannot be read."""
    return [{found[0] for slot in _slots_of(folder / name) if (found := _parsed(slot)) is not None} for name in FILES]


def _wrapping(key: bytes | None) -> AESGCM:
    derived = HKDF(SHA256(), KEY_BYTES, salt=None, info=b"keys of patients").derive(key or bytes(KEY_BYTES))
    return AESGCM(derived)


def _context(purpose: str, patient_id: str) -> bytes:
    """Return the associated data: content of another purpose or patient is not decrypted."""
    return f"{purpose}\0{patient_id}".encode()


def _opened(cipher: AESGCM, content: bytes, context: bytes) -> bytes:
    try:
        return cipher.decrypt(content[:NONCE_BYTES], content[NONCE_BYTES:], context)
    except (InvalidTag, ValueError) as error:
        raise StoreDamaged("encrypted content has changed, or belongs to another key") from error


def _slot(patient_id: str, wrapped: bytes) -> bytes:
    name = patient_id.encode()
    if len(name) > 32:
        raise ValueError(f"{patient_id!r:.60} is too long for a patient id")
    content = _CONTENT.pack(_MAGIC, name, wrapped)
    return content + hashlib.sha256(content).digest()


def _parsed(slot: bytes) -> tuple[str, bytes] | None:
    """Return patient id and wrapped key of a slot; None if it is damaged or empty."""
    content, digest = slot[: _CONTENT.size], slot[_CONTENT.size :]
    if not content.startswith(_MAGIC) or hashlib.sha256(content).digest() != digest:
        return None
    _, name, wrapped = _CONTENT.unpack(content)
    return name.rstrip(b"\0").decode(), wrapped


def _slots_of(path: Path) -> list[bytes]:
    """Return the slots of a file, without an incomplete last one; none of a missing file."""
    content = path.read_bytes() if path.exists() else b""
    return [content[start : start + SLOT_BYTES] for start in range(0, len(content) - SLOT_BYTES + 1, SLOT_BYTES)]


def _merged(first: list[bytes], second: list[bytes]) -> list[bytes | None]:
    """Return each slot as the first copy that has it whole; None where none has, but not beyond the shorter copy."""
    slots = [
        next((slot for slot in copies if _parsed(slot) is not None), None)
        for copies in zip_longest(first, second, fillvalue=b"")
    ]
    while len(slots) > min(len(first), len(second)) and slots[-1] is None:
        slots.pop()
    return slots


def _write_slot(path: Path, place: int, slot: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(place * SLOT_BYTES)
        file.write(slot)
        file.flush()
        fsync(file.fileno())
