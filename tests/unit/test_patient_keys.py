"""Keys of patients: two copies, damage and healing, erasure, another process, and a key that comes later."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from services.errors import RecordErased, StoreDamaged
from services.records.patient_keys import DEVICE, FILES, SLOT_BYTES, PatientKeys, ids_in_files
from services.records.record_files import note_key

KEY = bytes(range(32))
PATIENTS = [f"{number:016x}" for number in range(5)]
CONTENT = b"Ramakrishnan Venkataraman"


def filled(folder: Path, key: bytes | None = KEY) -> dict[str, bytes]:
    """Make the keys of PATIENTS and return the content of each, encrypted."""
    folder.mkdir(exist_ok=True)
    keys = PatientKeys(folder, key)
    for patient in PATIENTS:
        keys.create(patient)
    return {patient: keys.encrypt(patient, CONTENT, "name") for patient in (DEVICE, *PATIENTS)}


def read_back(folder: Path, stored: dict[str, bytes], key: bytes | None = KEY) -> int:
    """Open the keys once more; return how many contents are as they were. Every other one is reported."""
    keys, whole = PatientKeys(folder, key), 0
    for patient, content in stored.items():
        try:
            assert keys.decrypt(patient, content, "name") == CONTENT
        except StoreDamaged:
            continue
        whole += 1
    return whole


def test_content_is_bound_to_its_patient_its_purpose_and_the_key_of_the_store(tmp_path: Path) -> None:
    stored = filled(tmp_path)
    keys = PatientKeys(tmp_path, KEY)
    assert keys.decrypt(PATIENTS[1], stored[PATIENTS[1]], "name") == CONTENT
    assert all(CONTENT not in path.read_bytes() for path in tmp_path.iterdir())
    assert keys.encrypt(PATIENTS[1], CONTENT, "name") != stored[PATIENTS[1]]
    changed = bytearray(stored[PATIENTS[1]])
    changed[-1] ^= 1
    for patient, content, purpose in (
        (PATIENTS[2], stored[PATIENTS[1]], "name"),
        (PATIENTS[1], stored[PATIENTS[1]], "phone"),
        (PATIENTS[1], bytes(changed), "name"),
        (PATIENTS[1], b"short", "name"),
        ("unknown", stored[PATIENTS[1]], "name"),
    ):
        with pytest.raises(StoreDamaged):
            keys.decrypt(patient, content, purpose)
    with pytest.raises(StoreDamaged):
        PatientKeys(tmp_path, b"another key" * 3).decrypt(PATIENTS[1], stored[PATIENTS[1]], "name")


def test_an_erased_key_is_overwritten_in_both_files_and_never_comes_back(tmp_path: Path) -> None:
    stored = filled(tmp_path)
    older = (tmp_path / FILES[1]).read_bytes()
    running = PatientKeys(tmp_path, KEY)  # of another process, which has used the key
    running.encrypt(PATIENTS[2], CONTENT, "name")
    inodes = [(tmp_path / name).stat().st_ino for name in FILES]
    PatientKeys(tmp_path, KEY).erase(PATIENTS[2])
    wrapped = older[3 * SLOT_BYTES + 36 : 3 * SLOT_BYTES + 96]
    assert all(wrapped not in (tmp_path / name).read_bytes() for name in FILES)
    assert [(tmp_path / name).stat().st_ino for name in FILES] == inodes  # in place: no older file in free blocks
    running.create(PATIENTS[2])
    with pytest.raises(RecordErased):
        running.decrypt(PATIENTS[2], stored[PATIENTS[2]], "name")
    with pytest.raises(RecordErased):
        running.encrypt(PATIENTS[2], CONTENT, "name")
    running.erase("unknown")
    (tmp_path / FILES[1]).write_bytes(older)  # killed between the two files
    with pytest.raises(RecordErased):
        PatientKeys(tmp_path, KEY).decrypt(PATIENTS[2], stored[PATIENTS[2]], "name")
    assert wrapped not in (tmp_path / FILES[1]).read_bytes()


def flipped(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[2 * SLOT_BYTES + 50] ^= 4
    path.write_bytes(content)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(
    "damage",
    [
        flipped,
        Path.unlink,
        lambda path: path.write_bytes(b""),
        lambda path: os.truncate(path, 3 * SLOT_BYTES + 7),
        lambda path: path.write_bytes(os.urandom(20 * SLOT_BYTES)),
    ],
    ids=["bit", "gone", "empty", "truncated", "foreign"],
)
def test_damage_of_one_copy_loses_no_key_and_is_healed(
    tmp_path: Path, name: str, damage: Callable[[Path], object]
) -> None:
    stored = filled(tmp_path)
    before = (tmp_path / name).read_bytes()
    running = PatientKeys(tmp_path, KEY)
    damage(tmp_path / name)
    if (tmp_path / name).exists():  # while the program runs, the other copy is read
        assert all(running.decrypt(patient, content, "name") == CONTENT for patient, content in stored.items())
    assert read_back(tmp_path, stored) == len(stored)
    assert [(tmp_path / file).read_bytes() for file in FILES] == [before, before]


def test_a_slot_that_is_damaged_in_both_copies_is_lost_for_that_patient_alone(tmp_path: Path) -> None:
    stored = filled(tmp_path)
    for name in FILES:
        flipped(tmp_path / name)
    assert ids_in_files(tmp_path) == [{DEVICE, *PATIENTS} - {PATIENTS[1]}] * 2
    assert read_back(tmp_path, stored) == len(stored) - 1
    keys = PatientKeys(tmp_path, KEY)
    with pytest.raises(StoreDamaged, match=PATIENTS[1]):
        keys.decrypt(PATIENTS[1], stored[PATIENTS[1]], "name")
    keys.create("next")
    assert keys.decrypt("next", keys.encrypt("next", CONTENT, "name"), "name") == CONTENT


def test_a_key_that_another_process_made_is_found(tmp_path: Path) -> None:
    filled(tmp_path)
    first, second = PatientKeys(tmp_path, KEY), PatientKeys(tmp_path, KEY)
    for number in range(4):
        maker, reader = (first, second) if number % 2 else (second, first)
        maker.create(f"new {number}")
        assert reader.decrypt(f"new {number}", maker.encrypt(f"new {number}", CONTENT, "name"), "name") == CONTENT
        reader.create(f"new {number}")
    assert (tmp_path / FILES[0]).stat().st_size == SLOT_BYTES * (1 + len(PATIENTS) + 4)


def test_the_first_opening_with_a_key_wraps_all_keys_with_it(tmp_path: Path) -> None:
    stored = filled(tmp_path, None)
    assert read_back(tmp_path, stored, None) == len(stored)
    assert read_back(tmp_path, stored) == len(stored)
    assert read_back(tmp_path, stored) == len(stored)  # interrupted before the key was noted
    note_key(tmp_path, KEY)
    assert read_back(tmp_path, stored, None) == 0
    assert read_back(tmp_path, stored) == len(stored)
