"""Record of files: a data folder, calibrations, a signed file, an export, settings and journals, kept as written.

kept/data/              the instrument's data folder: store, dose ledger, journal of interrupted captures, settings
kept/calibrations/      two calibrations
kept/sent.calibration   one of them as a signed file; key, key.pub belong to this record only
kept/export.zip         a downloaded visit
kept/send.toml          settings of the upload
kept/update/            the state of an update
records/files.json      the content of all of these as read by the code
records/schema.sql      the tables
"""

import hashlib
import json
import re
import shutil
import sqlite3
from contextlib import ExitStack, closing
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from device.calibration.archive import Archive
from device.calibration.signing import create_key_pair, export, read_export, read_signer
from device.clock import VirtualClock
from device.config.head_file import load_head
from services.delivery.uploader import load_settings
from services.delivery.visit_export import export_files, folder_name, zip_archive
from services.errors import ReceiverUnreachable
from services.identity.users import UserTable
from services.instrument.accuracy_explorer import AccuracyExplorer
from services.records.capture_journal import CaptureJournal, InterruptedCapture
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.programme import load_programme
from services.records.upload_queue import UploadQueue, UploadReceipt
from services.records.visit_document import visit_document
from services.records.visit_repository import VisitRepository
from services.research.frontier import measure_scene
from services.update.ipc import STATE_FILE, StoredError, read_state, write_state
from services.update.state import StateFile
from tests.golden import compare
from tests.journey.conftest import SMALL_HEAD, GateClock, Rig, rig_builder, traced_world, until
from tests.unit.test_archive import WHO, calibration

KEPT = Path(__file__).parent / "kept"
SCHEMA = compare.RECORDS / "schema.sql"
DAY_S = 86400.0
NOON = datetime(2026, 3, 2, 12, tzinfo=UTC)
LATER = NOON + timedelta(days=5)  # time of reading: no finish can be undone any more
PIN = "274913"
SETTINGS = 'address = "https://reader.example.org/inbox"\ntoken = "send.token"\nanswer_s = 12.5\n'
NAMES = re.compile(r"\d{8}T\d{6}-(?:(?:OD|OS)-)?[0-9a-f]{6}")
PATIENT = re.compile(r"\b(?!0{8})[0-9a-f]{16}\b")
DIGEST = re.compile(r"\b[0-9a-f]{64}\b")
ENCRYPTED = re.compile(r"[A-Za-z0-9+/]{40,}={0,2}")  # base64 of a nonce, a short content and a tag


# Writing


def make(folder: Path) -> None:
    """Write every file with the present code; `folder` must not exist yet."""
    folder.mkdir(parents=True)
    _make_data(folder)
    archive = Archive(folder / "calibrations")
    archive.add_and_activate(calibration(65.0), WHO)
    archive.add_and_activate(calibration(), WHO)
    create_key_pair(folder / "key", "Golden record")
    export(archive.files(archive.active_id()), folder / "sent.calibration", folder / "key")
    (folder / "send.toml").write_text(SETTINGS, encoding="utf-8")
    (folder / "update").mkdir()
    state = {"state": "installed", "version": "0.2.0", "before": "0.1.0", "share": 1.0, "ill": ("clock",)}
    StateFile(folder / "update").write(**state, spent_s=61.5, took_s=140.0)
    trouble = StoredError(code="update.failed", message="the page does not answer", remedy="Call the technician.")
    StateFile(folder / "update").write(trouble=trouble)
    for lock in folder.rglob(".lock"):
        lock.unlink()


def _make_data(folder: Path) -> None:
    """Write the data folder.

    The folder holds a sent visit, an open one, one waiting for upload, a test picture and a quarantined capture.
    """
    with TemporaryDirectory() as place, ExitStack() as undo:
        head = Path(place) / "small.toml"
        head.write_text(SMALL_HEAD)
        spec = load_head(head)
        tiny = {"rows": 90, "cols": 160, "pitch_um": 3 * spec.camera.pitch_um}
        spec = spec.model_copy(update={"camera": spec.camera.model_copy(update=tiny)})
        clock = GateClock()
        clock.start = NOON
        rig = rig_builder(traced_world(spec), Path(place) / "plans")(Path(place), undo, clock=clock)
        _visits(rig)
        rig.arbiter.close()
        ledger = DoseLedgerStore(rig.store.engine, clock, DAY_S, boot="once")
        ledger.reserve(("OS",), 0.001, 0.1)  # never settled: the process was killed
        AccuracyExplorer(
            rig.store.folder / "accuracy", Path(place), clock, spec, lambda *_, **__: None, measure_scene
        ).choose("quick")
        UserTable(rig.store.folder / "access").add("Asha", PIN, ["administrator"])
        visit = next(
            candidate
            for candidate in rig.request("GET", "/api/visits").json()["visits"]
            if candidate["number"] == "B-7"
        )
        lost = InterruptedCapture("20260302T120500-OS-abcdef", "OS", visit["id"], "L-nerve", 1)
        CaptureJournal(rig.store).begin(lost, "0" * 16)
        (folder / "export.zip").write_bytes(rig.request("GET", f"/api/visits/{visit['id']}/export.zip").content)
        rig.store.close()
        torn = rig.store.folder / "captures" / ".20260302T120600-OD-fedcba.part"
        torn.mkdir()
        (torn / "raw.tiff").write_bytes(b"half of a frame")
        shutil.copytree(rig.store.folder, folder / "data")


def _visits(rig: Rig) -> None:
    keys = (f"{number:016x}" for number in range(1, 1000))

    def ask(method: str, path: str, **body: Any) -> dict[str, Any]:
        answer = rig.request(method, f"/api/{path}", json={"key": next(keys), **body})
        assert answer.status_code in (200, 201), answer.text
        rig.clock.sleep(60)
        return dict(answer.json())

    def begin(**fields: Any) -> str:
        number = fields.pop("number", None)
        id = str(ask("POST", "visits", **({"number": number} if number else {}))["id"])
        for name, value in fields.items():
            ask("PATCH", f"visits/{id}", field=name, value=value)
        return f"visits/{id}"

    def pressed(at: str, *slots: str) -> str:
        for slot in slots:
            eye = "OD" if slot.startswith("R") else "OS"
            made = ask("POST", "captures", eye=eye, visit=at.removeprefix("visits/"), slot=slot)
        return str(made["id"])

    known = {"name": "Meena K.", "village": "Nowhere", "phone": "12345", "age": 54, "vision_od": "6/9"}
    sent = begin(consent="agreed", **known)
    pressed(sent, "R-centre", "R-nerve", "R-centre")
    ask("POST", f"{sent}/not-possible", slot="L-centre", reason="cloudy")
    ask("POST", f"{sent}/finish")
    still_open = begin(number="B-7", consent="agreed", complaints=["pain"])
    moved = pressed(still_open, "L-centre")
    ask("POST", f"captures/{moved}/eye", eye="OD")
    waits = begin(consent="declined")
    ask("POST", f"{waits}/finish")
    ask("POST", "captures", eye="OS")
    until(lambda: not rig.exam.calibration_monitor.has_pending)
    queue = UploadQueue(rig.store.engine, rig.clock)
    first, second = queue.queued()
    queue.record_failure([first, second], ReceiverUnreachable("the receiver answers 503"))
    queue.record_success(first, UploadReceipt("5a" * 32, "sha256"))


# Reading


def read_all(folder: Path) -> dict[str, Any]:
    """Return the content of a copy of these files as read by the present code; times are UTC, names as kept."""
    return read_data(folder / "data") | {
        "settings": _read_settings(folder, VirtualClock(LATER)),
        "calibrations": _read_calibrations(folder),
        "update": read_state(folder / "update").model_dump(mode="json", exclude={"boot"}),
    }


def read_data(folder: Path) -> dict[str, Any]:
    """Return the content of a copy of a data folder as read by the present code."""
    clock = VirtualClock(LATER)
    with CaptureStore(folder, reserve_bytes=0, clock=clock) as store:
        return {
            "store": _read_store(store),
            "visits": _read_visits(store, clock),
            "uploads": _read_uploads(store, clock),
            "interrupted": [asdict(capture) for capture in CaptureJournal(store).interrupted],
            "spent_j_per_cm2": _read_doses(store),
        }


def _read_store(store: CaptureStore) -> dict[str, Any]:
    kept = [
        {
            "id": capture.id,
            "eye": capture.eye,
            "taken_at": capture.taken_at.isoformat(),
            "simulated": capture.simulated,
            "calibration": capture.calibration_id,
            "report": capture.report.as_json(),
            "files": dict(capture.files),
            "sizes": {name: len(store.read(capture.id, name)) for name in capture.files},
        }
        for capture in store.captures()
    ]
    return {
        "captures": kept,
        "damaged": store.damaged(),
        "torn": list(store.quarantine.sizes_bytes()),
        "orphans": store.quarantine.orphans(),
    }


def _read_visits(store: CaptureStore, clock: VirtualClock) -> dict[str, Any]:
    people = VisitRepository(store.engine, load_programme(), clock)
    visits = [visit_document(visit, people.undo_until(visit)).model_dump(mode="json") for visit in people.visits(50)]
    exports = {}
    for visit in people.visits(50):
        name = folder_name(visit)
        content = zip_archive(name, export_files(store, people, visit), visit.begun_at)
        exports[visit.number] = hashlib.sha256(content).hexdigest()
    return {"visits": visits, "counts": people.counts(), "damaged": people.damaged(), "exports": exports}


def _read_uploads(store: CaptureStore, clock: VirtualClock) -> dict[str, Any]:
    queue = UploadQueue(store.engine, clock)
    waiting = [
        {
            "visit": entry.visit,
            "number": entry.number,
            "finished_at": entry.finished_at.isoformat(),
            "tries": entry.tries,
            "failing_since": entry.failing_since and entry.failing_since.isoformat(),
            "error": entry.error,
            "message": entry.message,
            "stuck": entry.stuck,
            "size_bytes": entry.size_bytes,
        }
        for entry in queue.queued(sizes=True)
    ]
    trouble = queue.status()
    return {"waiting": waiting, "numbers": [trouble.waiting, trouble.stuck, trouble.failing]}


def _read_doses(store: CaptureStore) -> dict[str, float]:
    """Return the doses as counted by the process after a restart, before any interval expires."""
    ledger = DoseLedgerStore(store.engine, VirtualClock(), DAY_S, boot="another")
    return {eye: float(f"{ledger.spent_j_per_cm2(eye):.9g}") for eye in ("OD", "OS")}


def _read_settings(folder: Path, clock: VirtualClock) -> dict[str, Any]:
    users = UserTable(folder / "data" / "access")
    signed_in = users.verify("Asha", PIN)
    assert signed_in is not None
    spec = load_head(Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml")
    chosen = AccuracyExplorer(folder / "data" / "accuracy", folder, clock, spec, lambda *_, **__: None, measure_scene)
    send = load_settings(folder / "send.toml")
    return {
        "wrong pin": users.verify("Asha", PIN[::-1]),
        "roles": sorted(signed_in.roles),
        "pace": chosen.pace,
        "budget_s": chosen.budget_s,
        "send": {"address": send.address, "token": str(send.token), "answer_s": send.answer_s, "most_s": send.most_s},
    }


def _read_calibrations(folder: Path) -> dict[str, Any]:
    archive, found = Archive(folder / "calibrations"), {}
    for id in sorted(archive.ids()):
        kept = archive.load(id)
        maps = {name: getattr(kept.calibration, name) for name in ("dark_dn", "flat", "bad")}
        found[id] = {
            "psfs": [[psf.name, psf.colour, digest(psf.pixels.tobytes())] for psf in kept.calibration.psfs],
            "maps": {name: digest(pixels.tobytes()) for name, pixels in maps.items()},
            "serial": kept.provenance.serial,
            "made_by": kept.provenance.made_by,
            "made_at": kept.provenance.made_at.isoformat(),
            "temperature_c": kept.provenance.temperature_c,
            "figures": [list(figure) for figure in kept.provenance.figures],
            "field_deg": kept.calibration.field_deg,
            "black_dn": kept.calibration.sensor.black_dn,
            "pitch_um": kept.calibration.geometry.pitch_um,
        }
    files, signer = read_export(folder / "sent.calibration", (read_signer(folder / "key.pub"),))
    signed = {"files": {name: digest(content) for name, content in files.items()}, "signer": signer.name}
    return {"kept": found, "in force": archive.active_id(), "signed": signed}


def digest(content: bytes) -> str:
    """Return the SHA-256 in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


# Rewriting the content


def written_again(folder: Path, place: Path) -> dict[str, bool]:
    """Return for each file that is a function of its content whether the present code writes the same bytes."""
    clock = VirtualClock(LATER)
    archive, again = Archive(folder / "calibrations"), Archive(place / "again")
    id = archive.active_id()
    kept = archive.load(id)
    again.add_and_activate(kept.calibration, kept.provenance)
    export(archive.files(id), place / "sent", folder / "key")
    write_state(place, read_state(folder / "update"))
    with CaptureStore(folder / "data", reserve_bytes=0, clock=clock) as store:
        people = VisitRepository(store.engine, load_programme(), clock)
        (visit,) = (candidate for candidate in people.visits(50) if candidate.number == "B-7")
        name = folder_name(visit)
        zip_bytes = zip_archive(name, export_files(store, people, visit), visit.begun_at)
        lost = CaptureJournal(store).interrupted[0]
        note = store.folder / "journal" / f"{lost.id}.json"
        before = note.read_bytes()
        note.unlink()
        CaptureJournal(store).begin(lost, "0" * 16)
        journal = before == note.read_bytes()
    return {
        "calibration": again.files(id) == archive.files(id),
        "signed file": (place / "sent").read_bytes() == (folder / "sent.calibration").read_bytes(),
        "export": zip_bytes == (folder / "export.zip").read_bytes(),
        "journal of interrupted captures": journal,
        "state of an update": (place / STATE_FILE).read_bytes() == (folder / "update" / STATE_FILE).read_bytes(),
    }


# Shape of the written files: everything except random values and results of the solver


def shape(folder: Path) -> dict[str, Any]:
    """Return names of files and rows of tables, with captures and visits numbered and without digests."""
    names = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    names = [name for name in names if not name.endswith((".lock", "-wal", "-shm"))]
    with closing(sqlite3.connect(folder / "data" / "store.sqlite")) as tables:
        every = tables.execute("SELECT name FROM sqlite_schema WHERE type = 'table' ORDER BY name").fetchall()
        rows = {name: _rows(tables, name) for (name,) in every if not name.startswith("sqlite_")}
    found = numbered({"tables": rows, "files": names})
    return found | {"files": sorted(found["files"])}  # ids of calibrations are digests, and have no order of their own


def _rows(tables: sqlite3.Connection, name: str) -> list[dict[str, Any]]:
    found = tables.execute(f"SELECT * FROM {name} ORDER BY rowid")
    columns = [column[0] for column in found.description]
    return [{column: _plain(column, value) for column, value in zip(columns, row, strict=True)} for row in found]


def _plain(column: str, value: Any) -> Any:
    """Return a value of a row: the keys of a report and its parts, no length of a file, nine digits of a dose."""
    if column in ("report", "verdict", "laterality") and value is not None:
        return keys_of(json.loads(value))
    if column == "bytes":
        return None
    return float(f"{value:.6g}") if isinstance(value, float) else value


def keys_of(value: Any) -> Any:
    """Return the keys of nested JSON, with the type of each value."""
    return {key: keys_of(entry) for key, entry in value.items()} if isinstance(value, dict) else type(value).__name__


def numbered(value: Any) -> Any:
    """Return the value with names of captures and visits numbered, digests and encrypted texts as placeholders."""
    text = ENCRYPTED.sub("encrypted", PATIENT.sub("patient", DIGEST.sub("sha256", json.dumps(value))))
    for number, name in enumerate(dict.fromkeys(NAMES.findall(text)), 1):
        text = text.replace(name, f"name-{number}")
    return json.loads(text)


def schema(data: Path) -> str:
    """Return the statements of the tables and indices of a data folder, sorted, as text."""
    with closing(sqlite3.connect(data / "store.sqlite")) as tables:
        found = tables.execute("SELECT sql FROM sqlite_schema WHERE sql IS NOT NULL ORDER BY type, name").fetchall()
    return "".join(f"{statement.strip()};\n\n" for (statement,) in found)


def write() -> Path:
    """Rewrite all files, and the record of their content."""
    shutil.rmtree(KEPT, ignore_errors=True)
    make(KEPT)
    with TemporaryDirectory() as place:
        copy = Path(shutil.copytree(KEPT, Path(place) / "copy"))
        SCHEMA.write_text(schema(copy / "data"), encoding="utf-8")
        shapes = shape(copy)
        compare.write("files", {"read": read_all(copy), "shape": shapes})
    return KEPT
