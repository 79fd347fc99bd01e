"""Backups: a new device shows the same visits, captures, files and doses; damage is named and never silent."""

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pyrage
import pytest
from typer.testing import CliRunner

from device.clock import VirtualClock
from device.errors import StoreFull
from services.backup import store_contents
from services.backup.backup_folder import PATIENT_KEYS, BackupFolder, backup_path, find_folder
from services.backup.backup_key import (
    HEADER_FILES,
    KEY_FILE,
    BackupKey,
    SecretKey,
    encoded_model,
    key_for_passphrase,
    key_for_recipients,
    key_in,
    key_of_passphrase,
    read_header,
    read_key,
)
from services.backup.restore_backup import Restored, restore_backup
from services.backup.write_backup import write_backup
from services.cli import app
from services.errors import (
    BackupDamaged,
    BackupKeyWrong,
    RecordErased,
    RestoreRefused,
    StoreDamaged,
    UsbDriveUnavailable,
)
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.patient_keys import DEVICE, SLOT_BYTES, ids_in_files
from services.records.patient_keys import FILES as KEYS
from services.records.store_check import check_store
from tests.store_damage import FILES, expected, filled_store, shown

IDENTITY = pyrage.x25519.Identity.generate()
RECIPIENT = str(IDENTITY.to_public())
KEY = key_for_recipients([RECIPIENT])
SECRET = SecretKey(str(IDENTITY), KEY.secret)
CLOCK = VirtualClock()


def quiet(done: int, total: int) -> None:
    assert 0 <= done <= total


@pytest.fixture
def key() -> BackupKey:
    return KEY


def secret_key() -> SecretKey:
    """Return a new secret key of age."""
    return SecretKey(str(pyrage.x25519.Identity.generate()), KEY.secret)


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = filled_store(tmp_path_factory.mktemp("filled"), with_log=True)
    (folder / KEY_FILE).unlink()
    return folder


@pytest.fixture
def store(filled: Path, tmp_path: Path) -> Path:
    """A copy of one store for each test: to fill it takes a second."""
    return shutil.copytree(filled, tmp_path / "old")


@pytest.fixture
def stick(tmp_path: Path) -> Path:
    (tmp_path / "stick").mkdir()
    return tmp_path / "stick"


def restored_from(stick: Path, store: Path, number: int | None = None) -> Restored:
    return restore_backup(find_folder(stick), SECRET, store, quiet, number)


def add_capture(store: Path, id: str) -> None:
    with CaptureStore(store, reserve_bytes=0) as opened:
        opened.save(Capture(id, "OD", CLOCK.wall(), True, "00ff", CaptureReport(), {}), FILES)


def test_a_new_device_shows_what_the_old_one_showed(store: Path, stick: Path, tmp_path: Path, key: BackupKey) -> None:
    """The drill: the old device is gone, the new one was started once."""
    before = expected(store)
    made = write_backup(store, stick, CLOCK, quiet, key)
    shutil.rmtree(store)
    CaptureStore(tmp_path / "new", reserve_bytes=0).close()
    assert restored_from(stick, tmp_path / "new") == Restored(made.number, made.made_at, made.units, (), ())
    assert shown(tmp_path / "new") == (before, 0)


def test_every_file_of_the_store_is_restored_bit_for_bit(
    store: Path, stick: Path, tmp_path: Path, key: BackupKey
) -> None:
    """But for the tables, into which the doses of the device are carried, and their second copy, which follows them."""
    write_backup(store, stick, CLOCK, quiet, key)
    restored_from(stick, tmp_path / "new")
    replaced = ("store.sqlite", "dose-ledger.log", ".lock", "snapshots")

    def files(folder: Path) -> dict[str, tuple[bytes, int]]:
        paths = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
        found = {str(path.relative_to(folder)): (path.read_bytes(), path.stat().st_mode) for path in paths}
        return {name: file for name, file in found.items() if not name.startswith(replaced)}

    assert files(tmp_path / "new") == files(store) | {"backup.json": files(tmp_path / "new")["backup.json"]}
    assert read_key(tmp_path / "new") == key


def test_a_second_backup_writes_only_what_is_new(store: Path, stick: Path, key: BackupKey, tmp_path: Path) -> None:
    write_backup(store, stick, CLOCK, quiet, key)
    objects = {path: path.stat().st_mtime_ns for path in stick.rglob("objects/*")}
    add_capture(store, "later")
    made = write_backup(store, stick, CLOCK, quiet)
    after = {path: path.stat().st_mtime_ns for path in stick.rglob("objects/*")}
    assert (made.number, len(after) - len(objects)) == (2, 1)
    assert after.items() >= objects.items()
    assert restored_from(stick, tmp_path / "first", 1).units == made.units - 1
    assert restored_from(stick, tmp_path / "newest").units == made.units


def test_a_restored_device_continues_the_backups(store: Path, stick: Path, tmp_path: Path, key: BackupKey) -> None:
    write_backup(store, stick, CLOCK, quiet, key)
    objects = set(stick.rglob("objects/*"))
    restored_from(stick, tmp_path / "new")
    assert write_backup(tmp_path / "new", stick, CLOCK, quiet).number == 2
    assert set(stick.rglob("objects/*")) == objects


def test_nothing_on_the_stick_is_readable_without_the_key(store: Path, stick: Path, key: BackupKey) -> None:
    write_backup(store, stick, CLOCK, quiet, key)
    everything = b"".join(path.read_bytes() for path in stick.rglob("*") if path.is_file())
    names = " ".join(str(path) for path in stick.rglob("*"))
    of_store = b"".join(path.read_bytes() for path in store.rglob("*") if path.is_file())
    assert b"vision" in of_store
    assert not any(secret in everything for secret in (b"Name 1", b"vision", *FILES.values()))
    assert "2026-1-OD" not in names
    assert key.secret.encode() not in everything
    with pytest.raises(BackupKeyWrong, match="not that of these backups"):
        restore_backup(find_folder(stick), secret_key(), stick / "new", quiet)


def flip_slot(path: Path, slot: int) -> None:
    content = bytearray(path.read_bytes())
    content[slot * SLOT_BYTES + 60] ^= 1
    path.write_bytes(content)


def test_keys_of_patients_are_in_no_file_that_is_written_once(
    store: Path, stick: Path, key: BackupKey, tmp_path: Path
) -> None:
    write_backup(store, stick, CLOCK, quiet, key)
    wrapped = (store / KEYS[0]).read_bytes()[SLOT_BYTES : 2 * SLOT_BYTES]
    folder = find_folder(stick)
    for path in folder.rglob("*.age"):
        assert (wrapped in SECRET.decrypted(path.read_bytes())) == (path.name in PATIENT_KEYS), path
    inodes = [(folder / name).stat().st_ino for name in PATIENT_KEYS]
    patient = sorted(ids_in_files(store)[0] - {DEVICE})[0]
    with CaptureStore(store, reserve_bytes=0) as opened:
        opened.keys.erase(patient)
    write_backup(store, stick, CLOCK, quiet)
    assert [(folder / name).stat().st_ino for name in PATIENT_KEYS] == inodes
    restored_from(stick, tmp_path / "new", 1)  # the backup from before the erasure
    with CaptureStore(tmp_path / "new", reserve_bytes=0) as again, pytest.raises(RecordErased):
        again.keys.encrypt(patient, b"", "row")


@pytest.mark.parametrize("name", PATIENT_KEYS)
@pytest.mark.parametrize("gone", [False, True])
def test_damage_of_one_copy_of_the_keys_in_a_backup_loses_no_patient(
    store: Path, stick: Path, tmp_path: Path, key: BackupKey, name: str, gone: bool
) -> None:
    before = expected(store)
    flip_slot(store / KEYS[PATIENT_KEYS.index(name)], 2)  # and one bit of one copy on the device
    write_backup(store, stick, CLOCK, quiet, key)
    path = find_folder(stick) / name
    if gone:
        path.unlink()
    else:
        shutil.copy(backup_path(find_folder(stick), 1), path)  # sealed by the same device, but no keys
    assert restored_from(stick, tmp_path / "new").damaged_units == ()
    assert shown(tmp_path / "new") == (before, 0)


def test_keys_that_are_damaged_in_both_copies_are_reported_for_their_patients_alone(
    store: Path, stick: Path, tmp_path: Path, key: BackupKey
) -> None:
    before = expected(store)
    for copy in KEYS:
        flip_slot(store / copy, 2)
    write_backup(store, stick, CLOCK, quiet, key)
    assert restored_from(stick, tmp_path / "new").damaged_units == ()
    after, reported = shown(tmp_path / "new")
    assert (len(before.visits) - len(after.visits), reported > 0) == (1, True)
    assert after.visits.items() <= before.visits.items()
    (keys,) = (result for result in check_store(tmp_path / "new", str) if result.name == "keys of patients")
    assert (keys.whole, len(keys.damaged)) == (len(before.visits), 1)
    for name in PATIENT_KEYS:
        (find_folder(stick) / name).unlink()
    assert restored_from(stick, tmp_path / "without").damaged_units == PATIENT_KEYS[:1]


def test_a_passphrase_restores_and_another_does_not(store: Path, stick: Path, tmp_path: Path) -> None:
    before = expected(store)
    write_backup(store, stick, CLOCK, quiet, key_for_passphrase("four plain words here"))
    header = read_header(find_folder(stick))
    with pytest.raises(BackupKeyWrong):
        key_of_passphrase(header, "four plain words hers")
    identity = key_of_passphrase(header, "four plain words here")
    restore_backup(find_folder(stick), identity, tmp_path / "new", quiet)
    assert shown(tmp_path / "new") == (before, 0)


@pytest.mark.parametrize("make", [lambda: key_for_passphrase("short"), lambda: key_for_recipients(["age1xyz"])])
def test_a_key_that_protects_nothing_is_refused(make: Callable[[], BackupKey]) -> None:
    with pytest.raises(BackupKeyWrong):
        make()


def test_a_secret_key_that_is_given_as_a_recipient_is_not_repeated(store: Path, stick: Path) -> None:
    words = ["store", "backup", "--to", str(stick), "--data", str(store), "--recipient", str(IDENTITY)]
    refused = CliRunner().invoke(app, words).exception
    assert isinstance(refused, BackupKeyWrong)
    assert str(IDENTITY) not in f"{refused.message} {refused.remedy}"


def test_a_file_without_a_secret_key_is_refused(tmp_path: Path) -> None:
    (tmp_path / "key").write_text("# created by age-keygen\n")
    for path in (tmp_path / "key", tmp_path / "missing"):
        with pytest.raises(BackupKeyWrong, match=path.name):
            key_in(path, KEY.header)
    (tmp_path / "key").write_text(f"# created by age-keygen\n{IDENTITY}\n{key_for_recipients([RECIPIENT]).line}\n")
    with pytest.raises(BackupKeyWrong, match=f"begins with '# diffuscope backups {KEY.header.id}'"):
        key_in(tmp_path / "key", KEY.header)
    (tmp_path / "key").write_text(f"# created by age-keygen\n{IDENTITY}\n{KEY.line}\n")
    assert key_in(tmp_path / "key", KEY.header).opened(KEY.header.encrypted(KEY.sealed(b"content"))) == b"content"


def test_a_backup_needs_a_key(store: Path, stick: Path) -> None:
    with pytest.raises(BackupKeyWrong, match="no passphrase"):
        write_backup(store, stick, CLOCK, quiet)
    assert not list(stick.iterdir())


def test_a_device_with_records_is_not_overwritten(store: Path, stick: Path, tmp_path: Path, key: BackupKey) -> None:
    write_backup(store, stick, CLOCK, quiet, key)
    add_capture(tmp_path / "used", "mine")
    before = expected(tmp_path / "used")
    with pytest.raises(RestoreRefused, match="captures"):
        restored_from(stick, tmp_path / "used")
    assert shown(tmp_path / "used") == (before, 0)


def test_a_restoration_lowers_no_dose(store: Path, stick: Path, tmp_path: Path, key: BackupKey) -> None:
    before = expected(store)
    write_backup(store, stick, CLOCK, quiet, key)
    with CaptureStore(tmp_path / "new", reserve_bytes=0) as opened:
        ledger = DoseLedgerStore(opened.engine, VirtualClock(), 86_400.0, "boot")
        ledger.reserve(("OS",), 5.0, 10.0)
    restored_from(stick, tmp_path / "new")
    doses = shown(tmp_path / "new")[0].doses
    assert doses["OS"] == pytest.approx(5.0)  # a sum of two floating-point numbers
    assert doses["OD"] == before.doses["OD"]


def test_a_damaged_object_is_named_and_the_rest_is_restored(
    store: Path, stick: Path, tmp_path: Path, key: BackupKey
) -> None:
    made = write_backup(store, stick, CLOCK, quiet, key)
    damaged, gone, *_ = sorted(stick.rglob("objects/*.age"), key=lambda path: path.stat().st_size)
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    gone.unlink()
    result = restored_from(stick, tmp_path / "new")
    assert len(result.damaged_units) == 2
    names = {Path(unit).name for unit in result.damaged_units}
    found = shown(tmp_path / "new")[0]
    assert {id for id, _ in found.files} == {path.name for path in (store / "captures").iterdir()} - names
    add_capture(store, "later")
    assert write_backup(store, stick, CLOCK, quiet, verify=True).units == made.units + 1
    assert restored_from(stick, tmp_path / "mended").damaged_units == ()


def unreadable(path: Path) -> None:
    """Replace a file by one whose reading fails with EIO, as a bad sector does."""
    path.unlink()
    path.symlink_to("/proc/self/mem")


def test_a_bad_sector_costs_one_object_or_one_backup(store: Path, stick: Path, tmp_path: Path, key: BackupKey) -> None:
    write_backup(store, stick, CLOCK, quiet, key)
    write_backup(store, stick, CLOCK, quiet)
    unreadable(max(stick.rglob("backups/*.age")))
    unreadable(min(stick.rglob("objects/*.age")))
    result = restored_from(stick, tmp_path / "new")
    assert (result.number, result.damaged_backups, len(result.damaged_units)) == (1, (2,), 1)
    write_backup(store, stick, CLOCK, quiet, verify=True)
    assert restored_from(stick, tmp_path / "mended").damaged_units == ()


def test_a_stick_that_is_pulled_out_during_a_restoration_changes_nothing(
    store: Path, stick: Path, tmp_path: Path, key: BackupKey
) -> None:
    write_backup(store, stick, CLOCK, quiet, key)

    def pulled(done: int, _: int) -> None:
        if done == 2:
            stick.rename(tmp_path / "in a pocket")

    new = tmp_path / "new"
    with pytest.raises(UsbDriveUnavailable):
        restore_backup(find_folder(stick), SECRET, new, pulled)
    restored_from(tmp_path / "in a pocket", new)  # still unused
    assert shown(new) == (expected(store), 0)


def test_a_repeated_restoration_completes_the_one_that_a_power_cut_ended(
    store: Path, stick: Path, tmp_path: Path, key: BackupKey
) -> None:
    write_backup(store, stick, CLOCK, quiet, key)
    new = tmp_path / "new"
    restored_from(stick, new)
    (new / ".restored").mkdir()
    (new / "captures").rename(new / ".restored/captures")  # committed, and not moved into its place
    with pytest.raises(RestoreRefused):
        restored_from(stick, new)
    assert shown(new) == (expected(store), 0)


def test_an_older_backup_is_used_if_the_newest_is_damaged(
    store: Path, stick: Path, tmp_path: Path, key: BackupKey
) -> None:
    write_backup(store, stick, CLOCK, quiet, key)
    write_backup(store, stick, CLOCK, quiet)
    newest = max(stick.rglob("backups/*.age"))
    newest.write_bytes(newest.read_bytes()[:-20])
    assert (restored_from(stick, tmp_path / "new").number, restored_from(stick, tmp_path / "2").damaged_backups) == (
        1,
        (2,),
    )
    with pytest.raises(BackupDamaged):
        restored_from(stick, tmp_path / "third", 2)
    with pytest.raises(BackupDamaged, match="present: 1, 2"):
        restored_from(stick, tmp_path / "third", 7)


def test_a_backup_that_another_made_with_the_public_key_is_refused(
    store: Path, stick: Path, tmp_path: Path, key: BackupKey
) -> None:
    """The stick names the public key, so that its finder can encrypt records of its own; only the device can seal."""
    write_backup(store, stick, CLOCK, quiet, key)
    folder = find_folder(stick)
    (stick / "foreign").mkdir()
    foreign = BackupKey(header=read_header(folder), secret="0" * 64)
    write_backup(filled_store(tmp_path / "foreign", with_log=True), stick / "foreign", CLOCK, quiet, foreign)
    forged = next((stick / "foreign").rglob("backups/*.age"))
    for path in (stick / "foreign").rglob("objects/*"):
        shutil.copy(path, folder / "objects")
    for number, source in ((999_999, forged), (999_998, backup_path(folder, 1))):
        shutil.copy(source, backup_path(folder, number))
    shutil.rmtree(stick / "foreign")
    result = restored_from(stick, tmp_path / "new")
    assert (result.number, result.damaged_backups) == (1, (999_999, 999_998))
    assert shown(tmp_path / "new") == (expected(store), 0)
    with pytest.raises(BackupDamaged):
        restored_from(stick, tmp_path / "2", 999_999)


def test_a_forged_index_puts_no_object_into_the_next_backup(
    store: Path, stick: Path, tmp_path: Path, key: BackupKey
) -> None:
    write_backup(store, stick, CLOCK, quiet, key)
    index = next(stick.rglob("index.txt"))
    names = [line.split() for line in index.read_text().splitlines() if line]
    swapped = [f"{a[0]} {' '.join(b[1:])}" for a, b in zip(names, names[1:] + names[:1], strict=True)]
    index.write_text("\n".join(swapped))
    write_backup(store, stick, CLOCK, quiet)
    assert restored_from(stick, tmp_path / "new").damaged_units == ()
    assert shown(tmp_path / "new") == (expected(store), 0)


def test_a_torn_index_costs_a_copy_and_no_backup(store: Path, stick: Path, tmp_path: Path, key: BackupKey) -> None:
    before = expected(store)
    write_backup(store, stick, CLOCK, quiet, key)
    index = next(stick.rglob("index.txt"))
    for content in (index.read_bytes()[:-50], b"\0" * 300):
        index.write_bytes(content)
        write_backup(store, stick, CLOCK, quiet)
    restored_from(stick, tmp_path / "new")
    assert shown(tmp_path / "new") == (before, 0)


def test_a_stick_with_the_header_of_other_backups_gets_nothing(store: Path, stick: Path, key: BackupKey) -> None:
    """Otherwise the next backups would be encrypted for the holder of another key."""
    write_backup(store, stick, CLOCK, quiet, key)
    path = find_folder(stick) / "backup.json"
    path.write_bytes(encoded_model(key_for_recipients([secret_key().public_key]).header))
    with pytest.raises(BackupDamaged, match="not that of this device"):
        write_backup(store, stick, CLOCK, quiet)


@pytest.mark.parametrize("name", HEADER_FILES)
def test_one_copy_of_the_header_is_enough(store: Path, stick: Path, tmp_path: Path, key: BackupKey, name: str) -> None:
    write_backup(store, stick, CLOCK, quiet, key)
    (find_folder(stick) / name).write_bytes(b"\0" * 100)
    restored_from(stick, tmp_path / "new")
    write_backup(store, stick, CLOCK, quiet)
    contents = {(find_folder(stick) / file).read_bytes() for file in HEADER_FILES}
    assert len(contents) == 1, "the damaged copy is written again"


def test_a_stick_that_is_pulled_out_keeps_the_earlier_backups(
    store: Path, stick: Path, tmp_path: Path, key: BackupKey
) -> None:
    before = expected(store)
    write_backup(store, stick, CLOCK, quiet, key)
    for number in range(3):
        add_capture(store, f"later-{number}")

    def pulled(done: int, _: int) -> None:
        if done == len(store_contents.units(store)) - 2:
            stick.rename(tmp_path / "in a pocket")

    with pytest.raises(UsbDriveUnavailable):
        write_backup(store, stick, CLOCK, pulled)
    with pytest.raises(UsbDriveUnavailable):
        write_backup(store, stick, CLOCK, quiet)
    restored_from(tmp_path / "in a pocket", tmp_path / "new")
    assert shown(tmp_path / "new") == (before, 0)
    (tmp_path / "in a pocket").rename(stick)
    assert write_backup(store, stick, CLOCK, quiet).number == 2
    restored_from(stick, tmp_path / "newer")
    assert shown(tmp_path / "newer") == (expected(store), 0)


def test_a_capture_that_is_removed_during_a_backup_is_no_loss(
    store: Path, stick: Path, tmp_path: Path, key: BackupKey
) -> None:
    removed = "captures/test"

    def removing(done: int, _: int) -> None:
        if done == 1 and (store / removed).exists():
            shutil.rmtree(store / removed)
            with closing(sqlite3.connect(store / "store.sqlite", isolation_level=None)) as tables:
                tables.execute("DELETE FROM files WHERE capture_id = 'test'")
                tables.execute("DELETE FROM captures WHERE id = 'test'")

    write_backup(store, stick, CLOCK, removing, key)
    restored_from(stick, tmp_path / "new")
    found, reported = shown(tmp_path / "new")
    assert (reported, "test" in found.captures) == (0, False)


def test_a_file_that_the_disk_does_not_return_costs_its_folder_only(
    store: Path, stick: Path, tmp_path: Path, key: BackupKey
) -> None:
    unreadable(store / "captures/test/raw.tiff")
    made = write_backup(store, stick, CLOCK, quiet, key)
    assert made.unreadable == ("captures/test",)
    assert restored_from(stick, tmp_path / "new").units == made.units
    assert len(shown(tmp_path / "new")[0].visits) == len(shown(store)[0].visits)


def test_a_damaged_database_is_not_backed_up(store: Path, stick: Path, key: BackupKey) -> None:
    database = store / "store.sqlite"
    shown(store)
    content = bytearray(database.read_bytes())
    content[4096 * 3 : 4096 * 5] = bytes(8192)
    database.write_bytes(content)
    with pytest.raises(StoreDamaged, match=r"store\.sqlite|malformed|refused"):
        write_backup(store, stick, CLOCK, quiet, key)
    assert not list(stick.rglob("backups/*.age"))


def test_folders_that_hold_no_backup_are_named(stick: Path) -> None:
    with pytest.raises(BackupDamaged, match="none"):
        find_folder(stick)
    for number in range(2):
        BackupFolder(stick, key_for_recipients([RECIPIENT]))
        assert len(list(stick.iterdir())) == number + 1
    with pytest.raises(BackupDamaged, match="diffuscope-backup-"):
        find_folder(stick)


def test_a_restoration_without_room_changes_nothing(store: Path, stick: Path, tmp_path: Path, key: BackupKey) -> None:
    write_backup(store, stick, CLOCK, quiet, key)
    with pytest.raises(StoreFull):
        restore_backup(find_folder(stick), SECRET, tmp_path / "new", quiet, free_bytes=lambda _: 1000)
    assert [path.name for path in (tmp_path / "new").iterdir()] == [".lock"]


def test_an_archive_cannot_write_outside_the_store(tmp_path: Path) -> None:
    for name in ("../outside", "/etc/outside", "captures/../../outside"):
        with pytest.raises(BackupDamaged, match="outside"):
            list(store_contents.unpacked(store_contents.packed({name: b"content"})))
