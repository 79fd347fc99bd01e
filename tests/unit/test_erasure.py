"""Erasure of a patient: nothing of the patient is left, others are unchanged, kills, receipts, restored databases."""

import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pyrage
import pytest
from typer.testing import CliRunner

from device.errors import InputError, StoreError
from services.backup.backup_folder import find_folder
from services.backup.backup_key import SecretKey, key_for_recipients, write_key
from services.backup.restore_backup import restore_backup
from services.backup.write_backup import write_backup
from services.errors import RecordErased, RecordNotFound, StoreDamaged
from services.identity.audit_key import FILES as AUDIT_KEYS
from services.identity.audit_key import read_audit_key
from services.identity.erase_command import app
from services.identity.users import FOLDER
from services.records import erasure, patient_keys
from services.records.audit_log import AuditLog
from services.records.capture_journal import CaptureJournal
from services.records.capture_store import CaptureStore
from services.records.erasure import ErasureReceipt
from services.records.patient_keys import PatientKeys
from services.records.recovery_report import RecoveryReport
from services.records.store_check import check_store
from tests import erasures
from tests.erasures import CLOCK, NUMBER, OTHER, PEOPLE, capture_id, filled, opened, plain_files, repository

KILLS = 20


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return filled(tmp_path_factory.mktemp("original") / "store")


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    return shutil.copytree(original, tmp_path / "store")


def erased(folder: Path) -> ErasureReceipt:
    with opened(folder) as store:
        return store.erasures.erase(NUMBER, "requested", CLOCK.wall())[1]


def ids_of(folder: Path, number: str) -> list[str]:
    """Return patient id, visits and captures of a patient."""
    with opened(folder) as store:
        found = store.erasures.find(number)
    return [found.patient_id, *found.visits, *found.captures]


def plain_parts(number: str) -> list[bytes]:
    """Return what identifies a patient, and the first kilobyte of each picture and frame."""
    files = [plain_files(number, visit) for visit in (0, 1, 9)]
    return [number.encode(), *(value.encode() for value in PEOPLE[number].values())] + [
        content[:1024] for contents in files for content in contents.values()
    ]


def hits(folder: Path, parts: list[bytes]) -> list[tuple[str, bytes]]:
    """Return the files below a folder that contain one of these parts, or are named so."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return [
        (str(path.relative_to(folder)), part)
        for path in files
        for part in parts
        if part in path.read_bytes() or part in os.fsencode(path.relative_to(folder))
    ]


def shown(store: CaptureStore, number: str) -> list[object]:
    """Return all that a store shows of a patient: visits with history, and the content of every file."""
    people = repository(store)
    visits = people.visits(10, number=number)
    ids = [taken.capture for visit in visits for slot in visit.slots.values() for taken in slot.captures]
    files = {(id, name): store.read(id, name) for id in ids[:1] for name in store.get(id).files}
    return [visits, [people.changes(visit.id) for visit in visits], files]


def test_no_file_has_anything_of_an_erased_patient_and_the_others_are_unchanged(folder: Path) -> None:
    ids, other = ids_of(folder, NUMBER), ids_of(folder, OTHER)
    others_files = {path: path.read_bytes() for path, _ in _files_of(folder, other[1:])}
    with opened(folder) as store:
        before = shown(store, OTHER)
        store.erasures.erase(NUMBER, "requested", CLOCK.wall())
        assert shown(store, OTHER) == before
        assert repository(store).visits(10, number=NUMBER) == []
    assert hits(folder, plain_parts(NUMBER)) == []
    left = {path.name for path, _ in _files_of(folder, ids)}
    assert left == {erasure.LIST, *patient_keys.FILES}, "they keep the random patient id"
    assert {path: path.read_bytes() for path in others_files} == others_files
    with opened(folder) as store:
        assert shown(store, OTHER) == before
        assert store.recovery == RecoveryReport()
        assert [press.id for press in CaptureJournal(store).interrupted] == [capture_id(OTHER, 9)]
    assert not any(result.damaged for result in check_store(folder, lambda _: None, read_audit_key(folder)))


def _files_of(folder: Path, ids: list[str]) -> list[tuple[Path, bytes]]:
    found = hits(folder, [id.encode() for id in ids])
    return [(folder / name, part) for name, part in found if not name.startswith("store.sqlite")]


def test_the_number_of_an_erased_patient_is_free_for_another_one(folder: Path) -> None:
    before = ids_of(folder, NUMBER)
    with opened(folder) as store:
        store.erasures.erase(NUMBER, "withdrawn", CLOCK.wall())
        with pytest.raises(RecordNotFound):
            store.erasures.find(NUMBER)
        visit = repository(store).begin("f" * 16, NUMBER)
        assert visit.fields.keys().isdisjoint(PEOPLE[NUMBER])
    assert ids_of(folder, NUMBER)[0] != before[0]


def test_the_list_of_erasures_applies_to_a_restored_database_and_to_restored_keys(folder: Path, original: Path) -> None:
    erased(folder)
    listed = (folder / erasure.LIST).read_bytes()
    for restore_list in (True, False):  # without the list, the erased key alone shows which rows are erased again
        again = folder.with_name(f"again-{restore_list}")
        shutil.copytree(original, again)
        if restore_list:
            (again / erasure.LIST).write_bytes(listed)
        else:
            for name in patient_keys.FILES:
                shutil.copy(folder / name, again)
        with opened(again) as store:
            assert [visit.number for visit in repository(store).visits(10)] == [OTHER, OTHER]
        assert hits(again, [id.encode() for id in ids_of(original, NUMBER)[1:]]) == []


def test_a_line_that_another_program_wrote_erases_no_patient(folder: Path) -> None:
    receipt = erased(folder)
    with opened(folder) as store:
        other = store.erasures.find(OTHER).patient_id
    line = f'{{"patient_id": "{other}", "receipt": {receipt.model_dump_json()}}}\n'
    with (folder / erasure.LIST).open("a") as file:
        file.write(line + line[:40])
    with opened(folder) as store:
        assert store.erasures.find(OTHER).patient_id == other
    assert list(erasure.listed(folder, read_audit_key(folder)).values()) == [receipt]


def test_a_receipt_has_no_name_and_a_changed_one_is_refused(folder: Path) -> None:
    ids, key = ids_of(folder, NUMBER), read_audit_key(folder)
    receipt = erased(folder)
    content = receipt.model_dump_json().encode()
    assert erasure.verified(content, key) == receipt
    assert (receipt.visits, receipt.captures, receipt.files) == (2, 2, 10)
    assert not [part for part in (*plain_parts(NUMBER), *(id.encode() for id in ids)) if part in content]
    changed = receipt.model_copy(update={"visits": 1}).model_dump_json().encode()
    for forged, used in ((changed, key), (content, key[::-1]), (content, None)):
        with pytest.raises(StoreDamaged):
            erasure.verified(forged, used)
    for other in (b"{}", content[:-2], b"\xff"):
        with pytest.raises(InputError):
            erasure.verified(other, key)


def test_an_erasure_that_is_killed_at_any_point_is_finished_at_the_next_opening(original: Path, tmp_path: Path) -> None:
    def killed(points: list[int]) -> str:
        copies = [shutil.copytree(original, tmp_path / str(point)) for point in points]
        words = [f"{copy}:{point}" for copy, point in zip(copies, points, strict=True)]
        root = Path(erasures.__file__).parents[1]
        command = [sys.executable, erasures.__file__, *words]
        environment = {**os.environ, "PYTHONPATH": str(root)}
        return subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout

    lines = int(killed([0]))
    points = random.Random(7).sample(range(1, lines), KILLS)
    assert killed(points) == "", "each process was killed before the end"
    with opened(original) as store:
        others = shown(store, OTHER)
        visits = [visit.id for visit in repository(store).visits(10, number=NUMBER)]
    before = 0
    for point in points:
        copy = tmp_path / str(point)
        is_listed = (copy / erasure.LIST).exists() and (copy / erasure.LIST).stat().st_size > 0
        with opened(copy) as store:
            assert shown(store, OTHER) == others
            found = [visit.id for visit in repository(store).visits(10, number=NUMBER)]
            assert found == ([] if erasure.listed(copy, read_audit_key(copy)) else visits)
            before += not is_listed
        if erasure.listed(copy, read_audit_key(copy)):
            assert hits(copy, [visit.encode() for visit in visits]) == []
    assert 0 < before < KILLS


def mounted(image: Path, at: Path) -> Callable[[], None]:
    at.mkdir()
    subprocess.run(["mount", "-o", "loop", image, at], check=True)
    return lambda: subprocess.run(["umount", at], check=True) and None


@pytest.mark.skipif(os.geteuid() != 0, reason="only root mounts a file system")
def test_no_block_of_the_file_system_has_the_key_or_anything_else_of_an_erased_patient(tmp_path: Path) -> None:
    image, at = tmp_path / "image", tmp_path / "at"
    with image.open("wb") as file:
        file.truncate(48 << 20)
    subprocess.run(["mkfs.ext4", "-q", image], check=True)
    unmount = mounted(image, at)
    try:
        filled(at / "store")
        patient = ids_of(at / "store", NUMBER)[0].encode()
        slots = (at / "store" / patient_keys.FILES[0]).read_bytes()
        wrapped = slots[slots.index(patient) + 32 :][:60]
        os.sync()
        assert wrapped in image.read_bytes()
        erased(at / "store")
        assert hits(at, [wrapped, *plain_parts(NUMBER)]) == []
    finally:
        unmount()
    raw = image.read_bytes()
    assert [part for part in (wrapped, *plain_parts(NUMBER), *plain_parts(OTHER)) if part in raw] == []


def test_an_erased_patient_is_erased_for_another_process_too(folder: Path) -> None:
    with opened(folder) as running:
        visit = repository(running).visits(10, number=NUMBER)[0].id
        with closing(opened(folder)) as other:
            other.erasures.erase(NUMBER, "mistake", CLOCK.wall())
        with pytest.raises(RecordNotFound):
            repository(running).get(visit)
        with pytest.raises((RecordErased, RecordNotFound)):
            running.read(capture_id(NUMBER, 1), "picture.png")


def test_a_number_is_forgotten_as_soon_as_another_process_has_erased_the_key(folder: Path) -> None:
    """The rows follow later, or at the next opening after an interruption."""
    with opened(folder) as running:
        erased = running.erasures.find(NUMBER).patient_id
        PatientKeys(folder, read_audit_key(folder)).erase(erased)
        with pytest.raises(RecordNotFound):
            running.erasures.find(NUMBER)
        assert repository(running).visits(10, number=NUMBER) == []


def test_the_command_erases_a_patient_and_verifies_the_receipt(folder: Path) -> None:
    receipt = folder.parent / "receipt.json"
    words = ["patient", NUMBER.lower(), "--data", str(folder), "--receipt", str(receipt)]
    assert CliRunner().invoke(app, words, input="n\n").exit_code == 1
    ids_of(folder, NUMBER)  # still there
    with opened(folder), pytest.raises(StoreError, match="instrument is running"):
        CliRunner().invoke(app, [*words, "--yes"], catch_exceptions=False)
    assert CliRunner().invoke(app, [*words, "--reason", "none", "--yes"]).exit_code == 2
    done = CliRunner().invoke(app, [*words, "--reason", "withdrawn", "--yes"], catch_exceptions=False)
    assert "2 visits with 2 captures are erased" in done.stdout
    assert hits(folder, plain_parts(NUMBER)) == []
    (entry,) = AuditLog(folder, read_audit_key(folder), CLOCK).entries(10)
    assert (entry.action, entry.more) == ("erase-patient", {"field": "withdrawn", "by": "command"})
    check = ["verify", str(receipt), "--data", str(folder)]
    assert "2 visits with 2 captures were erased" in CliRunner().invoke(app, check, catch_exceptions=False).stdout
    receipt.write_text(receipt.read_text().replace("withdrawn", "mistake"))
    with pytest.raises(StoreDamaged, match="receipt was changed"):
        CliRunner().invoke(app, check, catch_exceptions=False)


def backed_up(folder: Path, to: Path) -> None:
    write_backup(folder, to, CLOCK, lambda done, total: None)


def restored(source: Path, folder: Path, key: SecretKey, number: int | None = None) -> None:
    restore_backup(find_folder(source), key, folder, lambda done, total: None, number)


def test_no_backup_brings_an_erased_patient_back_and_the_others_return_byte_for_byte(
    folder: Path, tmp_path: Path
) -> None:
    identity = pyrage.x25519.Identity.generate()
    key = key_for_recipients([str(identity.to_public())])
    secret = SecretKey(str(identity), key.secret)
    write_key(folder, key)
    stick, ids = tmp_path / "stick", ids_of(folder, NUMBER)
    stick.mkdir()
    backed_up(folder, stick)
    with opened(folder) as store:
        others = shown(store, OTHER)
    older = shutil.copytree(stick, tmp_path / "copy of the stick before the erasure")
    erased(folder)
    backed_up(folder, stick)

    restored(stick, tmp_path / "first backup", secret, 1)
    device = tmp_path / "device"  # without records, but it has erased the patient
    (device / FOLDER).mkdir(parents=True)
    for name in (erasure.LIST, *(f"{FOLDER}/{name}" for name in AUDIT_KEYS)):
        shutil.copy(folder / name, device / name)
    restored(older, device, secret)
    for place in (tmp_path / "first backup", device):
        with opened(place) as store:
            assert shown(store, OTHER) == others
            with pytest.raises(RecordNotFound):
                store.erasures.find(NUMBER)
        assert hits(place, [*plain_parts(NUMBER), *(id.encode() for id in ids[1:])]) == []

    restored(older, tmp_path / "elsewhere", secret)  # a copy of the keys that no backup has replaced
    ids_of(tmp_path / "elsewhere", NUMBER)


def test_what_an_older_backup_holds_of_an_erased_patient_is_encrypted(folder: Path, tmp_path: Path) -> None:
    identity = pyrage.x25519.Identity.generate()
    key = key_for_recipients([str(identity.to_public())])
    write_key(folder, key)
    backed_up(folder, tmp_path)
    before = set(tmp_path.rglob("*.age"))
    wrapped = (folder / patient_keys.FILES[0]).read_bytes()
    erased(folder)
    backed_up(folder, tmp_path)
    (patient_id,) = erasure.listed(folder, read_audit_key(folder))
    contents = [pyrage.decrypt(path.read_bytes(), [identity]) for path in before]
    slots = [wrapped[at : at + patient_keys.SLOT_BYTES] for at in range(0, len(wrapped), patient_keys.SLOT_BYTES)]
    gone = [slot for slot in slots if not any(slot in content for content in contents)]
    assert [patient_id.encode() in slot for slot in gone] == [True]
    assert not [part for part in plain_parts(NUMBER) for content in contents if part in content]
