"""Endpoints of the exports of visits: USB drives, ZIP download, copy on a drive."""

from pathlib import Path

from fastapi import APIRouter, Request
from fastapi.responses import Response

from services.delivery.usb_drives import UsbDrive, UsbDrives, copy_to_drive
from services.delivery.visit_export import ENCRYPTED_NAME, encrypted_copy, export_files, folder_name, zip_archive
from services.http.media import AgeResponse, ZipResponse, file_responses
from services.http.schemas.common import FolderName
from services.http.schemas.exports import UsbDriveAnswer, UsbDriveList, VisitExport
from services.records.capture_store import CaptureStore
from services.records.export_records import ExportRecords
from services.records.visit import Visit
from services.records.visit_repository import VisitRepository


def exports_router(repository: VisitRepository, store: CaptureStore, drives: UsbDrives) -> APIRouter:
    """Return the router of the exports of visits: to a USB drive, or as ZIP archive for download."""
    router = APIRouter()
    recipients = repository.programme.exports.recipients
    audited_as = "encrypted" if recipients else "plain"
    zip_or_age = file_responses(ZipResponse.media_type, AgeResponse.media_type)

    @router.get("/api/exports")
    def exports() -> UsbDriveList:
        """List the USB drives that are present, with their free space in bytes, and whether they can be written."""
        return UsbDriveList(folders=[_listed(drive) for drive in drives.present()])

    @router.get("/api/visits/{id}/export.zip", response_class=ZipResponse, responses=zip_or_age)
    def download(id: str, request: Request) -> Response:
        """Return a visit as ZIP archive, encrypted if the programme has public keys; 404 for an unknown visit."""
        request.state.audit_field = audited_as
        visit = repository.get(id)
        name, files = folder_name(visit), export_files(store, repository, visit)
        attachment = f'attachment; filename="{name}.zip'
        if recipients:
            content = encrypted_copy(visit, files, recipients)[ENCRYPTED_NAME]
            return AgeResponse(content, headers={"Content-Disposition": f'{attachment}.age"'})
        content = zip_archive(name, files, visit.begun_at)
        return ZipResponse(content, headers={"Content-Disposition": f'{attachment}"'})

    @router.post("/api/visits/{id}/export")
    def copy_visit(id: str, order: VisitExport, request: Request) -> FolderName:
        """Copy a visit to a USB drive: its files, or one encrypted file if the programme has public keys.

        Answers with the drive's name and the new folder on it; 404 for an unknown visit, 503 if the drive was removed
        or can only be read, 507 if it is full.
        """
        request.state.audit_field = audited_as
        visit = repository.get(id)
        key = order.key
        named = f"export {id} {order.folder}"
        copied = repository.requests.run_once(
            key, named, lambda: _copied(store, repository, visit, drives.mounted_folder(order.folder))
        )
        return FolderName(folder=copied.replace("/", f"/{visit.number}-", 1))

    return router


def _listed(drive: UsbDrive) -> UsbDriveAnswer:
    return UsbDriveAnswer(
        id=drive.id, name=drive.folder.name, free_bytes=drive.free_bytes, is_writable=drive.is_writable
    )


def _copied(store: CaptureStore, repository: VisitRepository, visit: Visit, drive: Path) -> str:
    """Copy a visit to a drive, and record it if finished; return drive and folder without the number: it is stored."""
    files = export_files(store, repository, visit)
    if recipients := repository.programme.exports.recipients:
        files = encrypted_copy(visit, files, recipients)
    folder = copy_to_drive(drive, folder_name(visit), files)
    if visit.finished_at is not None and store.refusal is None:
        ExportRecords(store.folder).write(visit.id, visit.finished_at, repository.clock.wall())
    return f"{drive.name}/{folder.name.removeprefix(f'{visit.number}-')}"
