"""Cases of power cuts while a backup is written to a FAT stick, and while a store is restored."""

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

import pyrage

from device.clock import VirtualClock
from services.backup.backup_folder import find_folder
from services.backup.backup_key import SecretKey, key_for_recipients, key_in, read_header, write_key
from services.backup.restore_backup import restore_backup
from services.backup.write_backup import write_backup
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from tests.hard.power_fat import FILES

IDENTITY = pyrage.x25519.Identity.generate()
KEY_FILE = "secret-key"


def quiet(done: int, total: int) -> None:
    pass


def save(store: Path, *names: str) -> None:
    with CaptureStore(store, reserve_bytes=0) as opened:
        for name in names:
            taken_at = datetime(2026, 3, 1, 12, tzinfo=UTC)
            opened.save(Capture(name, "OS", taken_at, False, "00ff", CaptureReport(), {}), FILES)


def secret_key(folder: Path) -> SecretKey:
    return key_in(folder / KEY_FILE, read_header(find_folder(folder / "stick")))


def with_backup(folder: Path) -> None:
    """Prepare a device with one capture, and a stick with its backup."""
    key = key_for_recipients([str(IDENTITY.to_public())])
    (folder / KEY_FILE).write_text(f"{IDENTITY}\n{key.line}\n")
    (folder / "stick").mkdir()
    save(folder / "device", "before")
    write_key(folder / "device", key)
    write_backup(folder / "device", folder / "stick", VirtualClock(), quiet)
    save(folder / "device", "later")


def back_up(folder: Path, acknowledge: Callable[[str], None]) -> None:
    write_backup(folder / "device", folder / "stick", VirtualClock(), quiet)
    acknowledge("backed up")


def restored_captures(folder: Path) -> tuple[set[str], tuple[int, ...]]:
    """Restore the newest readable backup, every unit of it; return its captures and the unreadable backups."""
    with TemporaryDirectory(dir=folder) as place:
        new = Path(place) / "new"
        restored = restore_backup(find_folder(folder / "stick"), secret_key(folder), new, quiet)
        assert restored.damaged_units == ()
        return {path.name for path in (new / "captures").iterdir()}, restored.damaged_backups


def judge_backup(folder: Path, acknowledged: list[str]) -> str:
    """The newest complete backup can be restored as a whole, and a further one can be written.

    A cut within the file of a backup leaves an incomplete one: it is reported, and the one before is used.
    """
    found, unreadable = restored_captures(folder)
    assert found == {"before", "later"} or (found == {"before"} and not acknowledged)
    assert unreadable in {(), (2,)} - {(2,) for _ in acknowledged}
    write_backup(folder / "device", folder / "stick", VirtualClock(), quiet)
    assert restored_captures(folder) == ({"before", "later"}, ())
    return "new" if "later" in found else "unreadable" if unreadable else "old"


def with_new_device(folder: Path) -> None:
    """Prepare a backup, and a new device that was started once."""
    with_backup(folder)
    save(folder / "new")


def restore(folder: Path, acknowledge: Callable[[str], None]) -> None:
    restore_backup(find_folder(folder / "stick"), secret_key(folder), folder / "new", quiet)
    acknowledge("restored")


def judge_restored(folder: Path, acknowledged: list[str]) -> str:
    """The store opens; it has all captures of the backup, or none and takes the backup then."""
    with CaptureStore(folder / "new", reserve_bytes=0) as store:
        found = {
            capture.id: {name: store.read(capture.id, name) for name in capture.files} for capture in store.captures()
        }
    assert found == {"before": FILES} or not (found or acknowledged)
    if not found:
        restore(folder, lambda word: None)
        assert (folder / "new/captures/before").is_dir()
    return "new" if found else "old"
