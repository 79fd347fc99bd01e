"""What a backup holds of a store: one unit for each folder of a capture, and the rest as one archive.

A unit is a second-level folder, such as `captures/<id>`, whose files rarely change. The rest is the database, as
SQLite's backup API copies it beside a running instrument, the records of patients and visits, the dose ledger, the
journal, and small files. Not backed up: NOT_BACKED_UP.
"""

import hashlib
import io
import sqlite3
import tarfile
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path

from device import atomic_io
from device.user_files import files_in
from services.errors import BackupDamaged, StoreDamaged
from services.identity import ssh_keys
from services.records import device_identity, patient_keys, reserve_file, schema, snapshots
from services.records.record_files import CAPTURE_RECORD

# Logs of the database (their rows are in its copy), older copies of it, the present reserve, and measurements of the
# computer, which another one has to make again; the identity of the device and the decisions on keys for SSH, since a
# restored device is another one. The keys of the patients are in a file of their own, which each backup replaces.
_DATABASE_LOGS = (f"{schema.DATABASE}-{suffix}" for suffix in snapshots.LOG_SUFFIXES)
_OTHERS = {"snapshots", "replaced", "plans", "accuracy", reserve_file.NAME, device_identity.FILE, ssh_keys.FILE}
NOT_BACKED_UP = frozenset({*_DATABASE_LOGS, *patient_keys.FILES, *_OTHERS})


def units(store: Path) -> list[str]:
    """Return the paths of the second-level folders of a store, relative to it, sorted."""
    tops = (top for top in _kept_in(store) if top.is_dir())
    return [str(folder.relative_to(store)) for top in tops for folder in _kept_in(top) if folder.is_dir()]


def fingerprint(store: Path, unit: str) -> bytes:
    """Return what identifies the content of a unit; FileNotFoundError if the unit was removed.

    The record of a capture has the SHA-256 of each of its files, so that they need not be read; otherwise it is the
    content of every file.
    """
    digest = hashlib.sha256(unit.encode())
    folder = store / unit
    has_record = (folder / CAPTURE_RECORD).exists()
    for path in _files_below(folder):
        digest.update(f"\0{path.relative_to(folder)}\0{path.stat().st_size}\0".encode())
        if not has_record or path.name == CAPTURE_RECORD:
            digest.update(path.read_bytes())
    return digest.digest()


def packed_unit(store: Path, unit: str) -> bytes:
    """Return a unit as a tar archive; FileNotFoundError if it was removed."""
    return packed({str(path.relative_to(store)): path for path in _files_below(store / unit)})


def rest_of_store(store: Path) -> dict[str, Path]:
    """Return the files that are in no unit, by their path in the store; without the database."""
    tops = _kept_in(store)
    found = [*tops, *(path for top in tops if top.is_dir() for path in _kept_in(top))]
    return {str(path.relative_to(store)): path for path in sorted(found) if path.is_file()}


def database_copy(database: Path) -> bytes:
    """Return a consistent copy of a database that may be in use; StoreDamaged if it fails the integrity check."""
    with closing(sqlite3.connect(database)) as source, closing(sqlite3.connect(":memory:")) as copy:
        source.backup(copy)
        problem = copy.execute("PRAGMA integrity_check(1)").fetchone()[0]
        if problem != "ok":
            remedy = "Stop the instrument, run diffuscope store rebuild, and repeat the backup."
            raise StoreDamaged(f"{database.name} is damaged: {problem}", remedy)
        return copy.serialize()


def packed(files: Mapping[str, Path | bytes]) -> bytes:
    """Return a tar archive of files by name, given as path or as content."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for name, source in files.items():
            entry = tarfile.TarInfo(name)
            content = source if isinstance(source, bytes) else source.read_bytes()
            entry.mode = atomic_io.PRIVATE_FILE
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    return out.getvalue()


def unpacked(content: bytes) -> Iterator[tuple[Path, bytes]]:
    """Yield path in the store and content of each file of a tar archive; BackupDamaged for an unsafe path."""
    try:
        with tarfile.open(fileobj=io.BytesIO(content), mode="r:") as archive:
            for entry in archive:
                path = Path(entry.name)
                file = archive.extractfile(entry)
                if file is None or path.is_absolute() or ".." in path.parts:
                    raise BackupDamaged(f"{entry.name!r:.80} is no file of a store")
                yield path, file.read()
    except tarfile.TarError as error:
        raise BackupDamaged(f"an archive of the backup cannot be read: {error}") from error


def _kept_in(folder: Path) -> list[Path]:
    """Return the files and folders of a folder that are backed up: parts of a write and locks begin with a dot."""
    return [path for path in files_in(folder) if path.name not in NOT_BACKED_UP]


def _files_below(folder: Path) -> list[Path]:
    """Return all files of a folder, sorted, without parts of writes and locks; FileNotFoundError without the folder."""
    folder.stat()
    return [path for path in files_in(folder, "**/*") if path.is_file()]
