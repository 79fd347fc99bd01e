"""Writing of a backup: only the folders of the store that the stick does not have yet, and all of the rest."""

import logging
from collections.abc import Callable
from pathlib import Path

from pydantic import AwareDatetime, BaseModel

from device.clock import Clock
from device.errors import StoreError
from services.backup import store_contents
from services.backup.backup_folder import BackupFolder
from services.backup.backup_key import BackupKey, LastBackup, read_key, write_key
from services.errors import BackupKeyWrong
from services.records import patient_keys, schema
from services.records.earlier_stores import require_store
from services.records.storage_errors import storage_errors

log = logging.getLogger(__name__)

MANIFEST = "manifest.json"
ATTEMPTS = 3  # a capture can be removed while the backup runs
Progress = Callable[[int, int], None]


class Manifest(BaseModel):
    """List of a backup: number, time, and the object (SHA-256) of each unit by its path in the store."""

    number: int
    made_at: AwareDatetime
    units: dict[str, str]


def write_backup(
    store: Path, place: Path, clock: Clock, progress: Progress, new_key: BackupKey | None = None, verify: bool = False
) -> LastBackup:
    """Back up a store, also a running one, to a stick or path; return the backup once it is durable and was read back.

    `progress` gets the number of folders of the store that are in the backup, and of all. `new_key` replaces the key of
    the backups, which then begin again in a folder of their own. `verify`: read the objects of earlier backups too, and
    write what has changed again. Errors: RecordNotFound (no store), BackupKeyWrong (no key is set), BackupDamaged (the
    stick does not return what was written, or has a folder of other backups), UsbDriveFull, UsbDriveUnavailable,
    StoreDamaged, StoreError.
    """
    require_store(store / schema.DATABASE)
    with storage_errors():
        key = new_key or read_key(store)
        if key is None:
            raise BackupKeyWrong("no passphrase and no key is set for backups", "Choose a passphrase first.")
        if new_key is not None:
            write_key(store, new_key)
        target = BackupFolder(place, key)
        for sha256 in target.forget_damaged(progress) if verify else ():
            log.warning("the object %s of the backup has changed; it is written again", sha256)
        for _ in range(ATTEMPTS):
            try:
                last = _written(store, target, key, clock, progress)
            except FileNotFoundError as error:  # a capture was removed; the objects that were written stay
                log.info("the backup begins again: %s was removed", error.filename)
                continue
            try:
                write_key(store, key.model_copy(update={"last": last}))
            except OSError as error:  # the card of the device is full: the backup is complete all the same
                log.warning("backup %s is complete, but is not recorded on this device: %s", last.number, error)
            return last
    raise StoreError("captures were removed during the backup", "Repeat it when no pictures are taken.")


def _written(store: Path, target: BackupFolder, key: BackupKey, clock: Clock, progress: Progress) -> LastBackup:
    """Write one backup; FileNotFoundError if a file of the store was removed meanwhile.

    The database is copied first: the folder of a capture is complete before its row, so no row is without its files.
    The time of a backup is that of its beginning: a capture that is taken while it runs may not be in it.
    """
    made_at = clock.wall()
    database = store_contents.database_copy(store / schema.DATABASE)
    paths = store_contents.units(store)
    objects = dict[str, str]()
    unreadable = list[str]()
    written_bytes = 0
    for done, unit in enumerate(paths):
        progress(done, len(paths))
        try:
            objects[unit], unit_bytes = _object_of(store, unit, target, key)
            written_bytes += unit_bytes
        except FileNotFoundError:
            raise
        except OSError as error:  # of a failing disk, on which the other captures must still be backed up
            log.error("%s cannot be backed up: %s", unit, error)
            unreadable.append(unit)
    number = target.next_number()
    rest = store_contents.rest_of_store(store) | {schema.DATABASE: database}  # the copy, not the file in use
    manifest = Manifest(number=number, made_at=made_at, units=objects)
    content = store_contents.packed({MANIFEST: manifest.model_dump_json().encode(), **rest})
    encrypted = key.header.encrypted(key.sealed(content))
    keys = store_contents.packed({name: store / name for name in patient_keys.FILES})
    target.replace_keys(key.header.encrypted(key.sealed(keys)))  # before the backup, which has no later patient
    target.add_backup(number, encrypted)
    progress(len(paths), len(paths))
    return LastBackup(
        number=number,
        made_at=made_at,
        folder=str(target.folder),
        units=len(objects),
        written_bytes=written_bytes + len(encrypted),
        unreadable=tuple(unreadable),
    )


def _object_of(store: Path, unit: str, target: BackupFolder, key: BackupKey) -> tuple[str, int]:
    """Return the object (SHA-256) of a unit, and the bytes that were written for it: 0 if the folder had it."""
    name = key.name(store_contents.fingerprint(store, unit))
    known = target.object_of(name)
    if known is not None:
        return known, 0
    encrypted = key.header.encrypted(store_contents.packed_unit(store, unit))
    return target.add(name, encrypted), len(encrypted)
