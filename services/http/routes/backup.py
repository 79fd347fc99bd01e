"""Endpoints of the technician's backups to a USB drive."""

from fastapi import APIRouter

from device.clock import Clock
from services.backup.backup_runner import BackupRunner
from services.delivery.usb_drives import UsbDrives
from services.health import thresholds
from services.http.problem_responses import error_text
from services.http.schemas.backup import BackupAnswer, BackupPassphrase, BackupRequest, LastBackupAnswer
from services.http.schemas.common import FolderName
from services.records.capture_store import CaptureStore


def backup_routes(runner: BackupRunner, store: CaptureStore, drives: UsbDrives, clock: Clock) -> APIRouter:
    """Return the router of the backups under /api/technician/backup."""
    router = APIRouter(prefix="/api/technician/backup")

    def answer() -> BackupAnswer:
        now = runner.state()
        last = None if now.last is None else LastBackupAnswer.model_validate(now.last, from_attributes=True)
        unsaved_since = store.first_taken_after(None if now.last is None else now.last.made_at)
        done, total = now.progress or (None, None)
        return BackupAnswer(
            has_key=now.has_key,
            last=last,
            is_due=thresholds.is_backup_due(clock.wall(), unsaved_since),
            done=done,
            total=total,
            error=error_text(now.error),
        )

    @router.get("")
    def state() -> BackupAnswer:
        """Return whether a passphrase is set, the last backup, and progress or error of the present one."""
        return answer()

    @router.post("/passphrase")
    def set_passphrase(chosen: BackupPassphrase) -> BackupAnswer:
        """Set the passphrase of the next backups, which then begin in a folder of their own.

        403 if it is too short, 409 during a backup. Takes some seconds.
        """
        runner.set_passphrase(chosen.passphrase)
        return answer()

    @router.post("")
    def begin(order: BackupRequest) -> FolderName:
        """Begin a backup to a USB drive; its progress, and later its error, are in the state.

        Answers with the name of the drive; 503 if it was removed, 409 during another backup.
        """
        place = drives.mounted_folder(order.folder)
        runner.begin(place)
        return FolderName(folder=place.name)

    return router
