"""Export of a visit: complete, verifiable and de-identified; errors of USB drives."""

import io
import json
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

import httpx
import pyrage
import pytest

from services.delivery.usb_drives import UsbDrives, copy_to_drive
from services.delivery.visit_export import zip_archive
from services.errors import UsbDriveFull, UsbDriveReadOnly, UsbDriveUnavailable
from services.http.app import create_app
from services.records.audit_log import AuditLog
from services.records.programme import Exports, load_programme
from tests.journey.conftest import drive_id

keys = (f"{number:016x}" for number in count(1))
FILES = {"R-centre-1.png": b"p" * 5000, "visit.json": b"{}"}


@pytest.fixture
def visit(rig: Any, drives: UsbDrives) -> Any:
    """Return a visit with a retake and identifying fields, on an instrument with one USB drive."""
    rig.application = create_app(rig.arbiter, rig.authenticator, usb_drives=drives)
    begun = rig.request("POST", "/api/visits", json={"key": next(keys)}).json()
    at = f"/api/visits/{begun['id']}"
    fields = {"consent": "agreed", "name": "Meena K.", "village": "Nowhere", "phone": "12345", "age": 54}
    for field, value in fields.items():
        rig.request("PATCH", at, json={"key": next(keys), "field": field, "value": value})
    for field, value in {"age": 55, "village": "Elsewhere"}.items():
        rig.request("PATCH", at, json={"key": next(keys), "field": field, "value": value})
    for _ in range(2):
        press = {"key": next(keys), "eye": "OD", "visit": begun["id"], "slot": "R-centre"}
        assert rig.request("POST", "/api/captures", json=press).status_code == 201
    return rig.request("GET", at).json()


def check(folder: Path) -> None:
    """Verify the checksums with sha256sum."""
    subprocess.run(["sha256sum", "--check", "--quiet", "--strict", "SHA256SUMS"], cwd=folder, check=True)


def test_the_zip_holds_pictures_reports_and_valid_checksums_and_no_identifying_field(
    rig: Any, visit: Any, tmp_path: Path
) -> None:
    answer = rig.request("GET", f"/api/visits/{visit['id']}/export.zip")
    assert answer.headers["content-type"] == "application/zip"
    assert visit["number"] in answer.headers["content-disposition"]
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.testzip() is None
        archive.extractall(tmp_path / "out")
    folder = tmp_path / "out" / f"{visit['number']}-{visit['id']}"
    check(folder)
    names = {path.name for path in folder.iterdir()}
    pictures = {f"R-centre-{number}.{kind}" for number in (1, 2) for kind in ("png", "json")}
    pictures |= {f"R-centre-{number}-colour.png" for number in (1, 2)}
    assert names == {"visit.json", "history.json", "SHA256SUMS"} | pictures
    for number, capture in enumerate(visit["slots"]["R-centre"]["captures"], 1):
        assert (folder / f"R-centre-{number}.png").read_bytes() == rig.store.read(capture, "picture.png")
        assert (folder / f"R-centre-{number}-colour.png").read_bytes() == rig.store.read(capture, "colour.png")
    exported = json.loads((folder / "visit.json").read_text())
    assert exported["fields"] == {"age": 55, "consent": "agreed"}
    shown = rig.request("GET", f"/api/visits/{visit['id']}/changes").json()["changes"]
    history = json.loads((folder / "history.json").read_text())["changes"]
    assert history == [change for change in shown if change["field"] not in ("name", "village", "phone")]
    assert ("age", 54, 55) in [(change["field"], change["was"], change["value"]) for change in history]
    assert exported["slots"] == visit["slots"]
    for secret in (b"Meena", b"Nowhere", b"Elsewhere", b"12345"):
        assert secret not in answer.content


@pytest.mark.parametrize("is_encrypted", [False, True])
def test_an_export_is_encrypted_to_the_keys_of_the_programme_and_the_audit_log_names_it(
    rig: Any, visit: Any, stick: Path, drives: UsbDrives, tmp_path: Path, is_encrypted: bool
) -> None:
    """Download and copy hold the plain archive, which the holder of the secret key only can read."""
    number, at = f"{visit['number']}-{visit['id']}", f"/api/visits/{visit['id']}/export"
    plain = rig.request("GET", f"{at}.zip").content
    identity, log = pyrage.x25519.Identity.generate(), AuditLog(tmp_path, b"k" * 32, rig.clock)
    exports = Exports(recipients=(str(identity.to_public()),) if is_encrypted else ())
    programme = load_programme().model_copy(update={"exports": exports})
    rig.application = create_app(rig.arbiter, rig.authenticator, programme, usb_drives=drives, audit_log=log)
    loaded = rig.request("GET", f"{at}.zip")
    copied = rig.request("POST", at, json={"key": next(keys), "folder": drive_id(stick)}).json()
    files = {path.name: path.read_bytes() for path in (stick.parent / copied["folder"]).iterdir()}
    fields = [entry.more["field"] for entry in log.entries(9, action="export")]
    if is_encrypted:
        assert loaded.headers["content-type"] == "application/octet-stream"
        assert loaded.headers["content-disposition"] == f'attachment; filename="{number}.zip.age"'
        assert set(files) == {"visit.zip.age"}
        assert [pyrage.decrypt(content, [identity]) for content in (loaded.content, *files.values())] == [plain] * 2
        with pytest.raises(pyrage.DecryptError):
            pyrage.decrypt(loaded.content, [pyrage.x25519.Identity.generate()])
    else:
        assert loaded.content == plain
        assert "visit.json" in files
    assert fields == ["encrypted" if is_encrypted else "plain"] * 2


def test_a_date_before_1980_does_not_fail_the_zip() -> None:
    content = zip_archive("A", FILES, datetime(1970, 1, 1, tzinfo=UTC))
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert {info.date_time[0] for info in archive.infolist()} == {1980}


def test_a_copy_on_a_usb_drive_is_complete_and_an_earlier_one_stays(rig: Any, visit: Any, stick: Path) -> None:
    listed = rig.request("GET", "/api/exports").json()["folders"]
    assert [(drive["id"], drive["name"]) for drive in listed] == [(drive_id(stick), "USB STICK")]
    assert listed[0]["free_bytes"] > 0
    order = {"key": next(keys), "folder": drive_id(stick)}
    at = f"/api/visits/{visit['id']}/export"
    made = rig.request("POST", at, json=order).json()
    assert rig.request("POST", at, json=order).json() == made
    check(stick.parent / made["folder"])
    other = rig.request("POST", at, json={**order, "key": next(keys)}).json()
    check(stick.parent / other["folder"])
    assert {path.name for path in stick.iterdir()} == {Path(export["folder"]).name for export in (made, other)}
    assert len(list(stick.iterdir())) == 2


def test_only_a_mounted_usb_drive_is_written(rig: Any, visit: Any, stick: Path) -> None:
    other = stick.parent / "not mounted"
    other.mkdir()
    folders = ("/", "/etc", f"{stick}/..", f"{stick}/", f"{stick}/../USB STICK", "..", "\x00", f"{other}")
    for folder in folders:
        order = {"key": next(keys), "folder": folder}
        answer: httpx.Response = rig.request("POST", f"/api/visits/{visit['id']}/export", json=order)
        assert (folder, answer.status_code, answer.json()["code"]) == (folder, 503, "stick.gone")
        assert list(stick.iterdir()) == list(other.iterdir()) == []


def test_a_removed_usb_drive_is_an_error_and_the_same_request_succeeds_later(
    rig: Any, visit: Any, stick: Path, tmp_path: Path
) -> None:
    order, at = {"key": next(keys), "folder": drive_id(stick)}, f"/api/visits/{visit['id']}/export"
    shutil.rmtree(stick)  # the mount table still lists it
    assert rig.request("GET", "/api/exports").json() == {"folders": []}
    gone = rig.request("POST", at, json=order)
    assert (gone.status_code, gone.json()["code"]) == (503, "stick.gone")
    assert "Nothing was lost" in gone.json()["remedy"]
    stick.mkdir()
    assert rig.request("POST", at, json=order).status_code == 200


def test_a_damaged_picture_fails_the_export_with_its_own_error(rig: Any, visit: Any) -> None:
    capture = visit["slots"]["R-centre"]["captures"][0]
    (rig.store.folder / "captures" / capture / "picture.png").write_bytes(b"x")
    answer = rig.request("GET", f"/api/visits/{visit['id']}/export.zip")
    assert (answer.status_code, answer.json()["code"]) == (500, "store.damaged")


def test_an_interrupted_copy_is_replaced(stick: Path) -> None:
    (stick / ".A.part").mkdir()
    (stick / ".A.part" / "visit.json").write_bytes(b"half")
    assert copy_to_drive(stick, "A", FILES) == stick / "A"
    assert {path.name for path in stick.iterdir()} == {"A"}
    with pytest.raises(UsbDriveUnavailable):
        copy_to_drive(stick / "gone", "A", FILES)


def test_a_full_usb_drive_is_an_error_and_no_partial_copy_remains(tmp_path: Path) -> None:
    """A limit on the length of a file simulates the full drive; it needs no privileges."""
    result = subprocess.run(
        [sys.executable, "-W", "error", __file__, str(tmp_path)],
        cwd=Path(__file__).parents[2],
        check=True,
        capture_output=True,
        text=True,
        env={"PYTHONPATH": str(Path(__file__).parents[2])},
    )
    assert result.stdout.split() == ["UsbDriveFull", "[]"]


if __name__ == "__main__":
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, resource.RLIM_INFINITY))
    try:
        copy_to_drive(Path(sys.argv[1]), "A", FILES)
    except UsbDriveFull as full:
        print(type(full).__name__, [path.name for path in Path(sys.argv[1]).iterdir()])  # noqa: T201


def test_a_drive_that_can_only_be_read_is_listed_as_such_and_refused(rig: Any, visit: Any, stick: Path) -> None:
    """As a stick whose switch is on, or one that the kernel has mounted read-only after an error."""
    with read_only(stick):
        listed = rig.request("GET", "/api/exports").json()["folders"]
        assert [(drive["name"], drive["is_writable"]) for drive in listed] == [("USB STICK", False)]
        order = {"key": next(keys), "folder": drive_id(stick)}
        refused = rig.request("POST", f"/api/visits/{visit['id']}/export", json=order)
        assert (refused.status_code, refused.json()["code"]) == (503, "stick.readonly")
        assert "write-protected" in refused.json()["remedy"]
        with pytest.raises(UsbDriveReadOnly, match=r"^USB STICK refused: Read-only"):
            copy_to_drive(stick, "A", FILES)


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Mount a read-only file system at a folder; only root can."""
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "ro", "none", folder], capture_output=True)
    if mounted.returncode != 0:
        pytest.skip("only root can mount")
    try:
        yield
    finally:
        subprocess.run(["umount", folder], check=True)


def test_no_answer_about_drives_has_a_folder(rig: Any, visit: Any, stick: Path) -> None:
    listed = rig.request("GET", "/api/exports").text
    order = {"key": next(keys), "folder": drive_id(stick)}
    copied = rig.request("POST", f"/api/visits/{visit['id']}/export", json=order).text
    shutil.rmtree(stick)
    gone = rig.request("POST", f"/api/visits/{visit['id']}/export", json={**order, "key": next(keys)}).text
    assert str(stick.parent) not in listed + copied + gone
