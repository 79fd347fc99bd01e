"""Restoration of a backup on a device that has no records yet: all that is whole, and the names of what is not."""

import logging
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from device import atomic_io
from device.errors import StoreFull
from services.backup import store_contents
from services.backup.backup_folder import PATIENT_KEYS, backup_numbers, backup_path, read_backup_file, read_object
from services.backup.backup_key import SecretKey, read_header
from services.backup.write_backup import MANIFEST, Manifest
from services.errors import BackupDamaged, BackupKeyWrong, RestoreRefused
from services.identity.audit_key import find_audit_key
from services.records import erasure, patient_keys, schema
from services.records.earlier_stores import refuse_earlier_store
from services.records.restoration import begin_restoration, commit_restoration, finish_restoration
from services.records.snapshots import carry_dose, refuse_in_use
from services.records.storage_errors import storage_errors

log = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
RECORD_FOLDERS = ("captures", "patients", "visits", "quarantine")


@dataclass(frozen=True)
class Restored:
    """What was restored: number and time of the backup, and the numbers of newer backups that are damaged.

    `units` counts the folders in the backup, `damaged_units` names those of them that were not restored.
    """

    number: int
    made_at: datetime
    units: int
    damaged_units: tuple[str, ...]
    damaged_backups: tuple[int, ...]


def restore_backup(
    folder: Path,
    key: SecretKey,
    store: Path,
    progress: Progress,
    number: int | None = None,
    free_bytes: Callable[[Path], int] = atomic_io.free_bytes,
) -> Restored:
    """Restore the newest readable backup in a folder of backups, or that with `number`, into an unused store.

    A backup needs the seal of its device, and every unit the SHA-256 in it; one that is missing, unreadable or changed
    is left out and named. A dose that the device has counted is never lowered, and patients whom it has erased are
    erased again by the next opening. Until the last step nothing in the store changes; what a power cut interrupts
    after it, the next opening or restoration completes. Errors: RestoreRefused
    (the store has records), BackupKeyWrong, BackupDamaged (no backup can be read), UsbDriveUnavailable, StoreFull,
    StoreError (the instrument is running, the disk refuses, or store or backup are of a version before the first
    release).
    """
    if key.public_key not in read_header(folder).recipients:
        raise BackupKeyWrong("the key is not that of these backups")
    with storage_errors():
        atomic_io.make_folder(store)
        refuse_earlier_store(store / schema.DATABASE)
        refuse_in_use(store / schema.DATABASE)
        with atomic_io.file_lock(store / ".lock"):
            finish_restoration(store)  # of a restoration that was committed before a power cut
            _refuse_used(store)
            manifest, rest, damaged_backups = _newest_readable(folder, key, number)
            _refuse_without_room(folder, manifest, len(rest), free_bytes(store))
            part = begin_restoration(store)
            _write_files(part, rest)
            refuse_earlier_store(part / schema.DATABASE, f"the backup in {folder}")
            damaged = _write_keys(part, folder, key) + _write_units(part, folder, manifest, key, progress)
            carry_dose(store / schema.DATABASE, part / schema.DATABASE)
            if (store / erasure.LIST).exists():
                erasure.carry_erasures(store, find_audit_key(store), part, find_audit_key(part))
            _sync_folders(part)
            commit_restoration(store)
    progress(len(manifest.units), len(manifest.units))
    return Restored(manifest.number, manifest.made_at, len(manifest.units), damaged, damaged_backups)


def _write_keys(part: Path, folder: Path, key: SecretKey) -> tuple[str, ...]:
    """Write the keys of the patients from the first copy that is whole; return the name of the file if none is."""
    for name in PATIENT_KEYS:
        try:
            files = dict(store_contents.unpacked(key.opened(read_backup_file(folder, folder / name))))
            if {str(path) for path in files} == set(patient_keys.FILES):  # and no other sealed archive
                for path, content in files.items():
                    atomic_io.write_file(part / path, content)
                return ()
        except BackupDamaged as error:
            log.error("%s cannot be used: %s", name, error.message)
    return PATIENT_KEYS[:1]


def _write_units(part: Path, folder: Path, manifest: Manifest, key: SecretKey, progress: Progress) -> tuple[str, ...]:
    """Write every unit of a backup that is whole to `part`; return those that are damaged."""
    damaged = []
    for done, (unit, sha256) in enumerate(manifest.units.items()):
        progress(done, len(manifest.units))
        try:
            with _naming(Path(unit)):
                content = key.decrypted(read_object(folder, sha256))
            _write_files(part, content)
        except BackupDamaged as error:
            log.error("%s is not restored: %s", unit, error.message)
            damaged.append(unit)
    return tuple(damaged)


def _refuse_used(store: Path) -> None:
    """Raise RestoreRefused if the store has captures, visits or patients."""
    used = [name for name in RECORD_FOLDERS if (store / name).is_dir() and any((store / name).iterdir())]
    database = store / schema.DATABASE
    if database.exists() and database.stat().st_size and not used:
        with closing(sqlite3.connect(database)) as tables:
            names = {name for (name,) in tables.execute("SELECT name FROM sqlite_schema")}
            for table in {"captures", "visits", "patients"} & names:
                if tables.execute(f"SELECT EXISTS (SELECT 1 FROM {table})").fetchone()[0]:
                    used.append(f"the table {table}")
    if used:
        raise RestoreRefused(f"{store} has records already: {', '.join(used)}")


def _newest_readable(folder: Path, key: SecretKey, number: int | None) -> tuple[Manifest, bytes, tuple[int, ...]]:
    """Return manifest and archive of a backup, and the numbers of newer ones that are damaged."""
    numbers = backup_numbers(folder)
    wanted = [known for known in reversed(numbers) if number is None or known == number]
    if not wanted:
        listed = ", ".join(map(str, numbers)) or "none"
        raise BackupDamaged(f"there is no backup {number or ''} in {folder}; present: {listed}")
    damaged: list[int] = []
    for candidate in wanted:
        try:
            path = backup_path(folder, candidate)
            with _naming(path):
                archive = key.opened(read_backup_file(folder, path))
            return _manifest(archive, candidate), archive, tuple(damaged)
        except BackupDamaged as error:
            log.error("backup %s cannot be used: %s", candidate, error.message)
            damaged.append(candidate)
    raise BackupDamaged(f"no backup in {folder} can be read with this key")


def _manifest(archive: bytes, number: int) -> Manifest:
    path, content = next(store_contents.unpacked(archive))
    if str(path) != MANIFEST:
        raise BackupDamaged("the archive of the backup has no list of its content")
    manifest = Manifest.model_validate_json(content)
    if manifest.number != number:
        raise BackupDamaged(f"it is a copy of backup {manifest.number}")
    return manifest


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Add the name of a file to a BackupDamaged of the block."""
    try:
        yield
    except BackupDamaged as error:
        raise BackupDamaged(f"{path.name}: {error.message}") from error


def _refuse_without_room(folder: Path, manifest: Manifest, rest_bytes: int, free_bytes: int) -> None:
    """Raise StoreFull if the restored files do not fit; encrypted objects are a little longer than their content."""
    paths = [folder / "objects" / f"{sha256}.age" for sha256 in manifest.units.values()]
    need_bytes = rest_bytes + sum(path.stat().st_size for path in paths if path.exists())
    if not atomic_io.has_room(need_bytes, free_bytes, 0):
        raise StoreFull(f"{free_bytes} bytes are free, {need_bytes} are needed", "Restore on a larger card.")


def _write_files(part: Path, archive: bytes) -> None:
    for path, content in store_contents.unpacked(archive):
        if str(path) != MANIFEST:
            atomic_io.make_folder((part / path).parent)
            atomic_io.write_file(part / path, content)


def _sync_folders(part: Path) -> None:
    """Sync every folder once; the files in them are durable."""
    for folder in [part, *(path for path in part.rglob("*") if path.is_dir())]:
        atomic_io.fsync_folder(folder)
