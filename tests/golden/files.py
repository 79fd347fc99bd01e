"""Record of files: a data folder, calibrations, a signed file, an export, settings and journals, kept as written.

kept/data/              the instrument's data folder: store, dose ledger, journal of interrupted captures, settings
kept/calibrations/      two calibrations
kept/sent.calibration   one of them as a signed file; key, key.pub are those of this record alone
kept/export.zip         a visit as it is downloaded
kept/send.toml          settings of the upload
kept/update/            the state of an update
records/files.json      what is read from all of these
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
from device.calibration.signed import export, new_key, read_export, read_signer
from device.clock import VirtualClock
from device.errors import PinWrong, SendUnreachable
from device.spec import load_head
from services.instrument.carrier import load_settings
from services.instrument.explorer import Explorer
from services.instrument.exporting import exported, folder_name, zipped
from services.instrument.technician import Door
from services.instrument.visits_api import shown_visit
from services.records.light_book import LightBook
from services.records.outbox import Outbox, Receipt
from services.records.people import People
from services.records.protocol import load_protocol
from services.records.store import Store
from services.records.underway import Lost, Underway
from services.records.update_notes import JOURNAL, Trouble, read_entry, write_entry
from services.update.journal import Journal
from tests.golden import compare
from tests.journey.conftest import SMALL_HEAD, GateClock, Rig, builder, traced, until
from tests.unit.test_archive import WHO, calibration

KEPT = Path(__file__).parent / "kept"
SCHEMA = compare.RECORDS / "schema.sql"
DAY_S = 86400.0
NOON = datetime(2026, 3, 2, 12, tzinfo=UTC)
LATER = NOON + timedelta(days=5)  # when everything is read: no finish can be undone any more
PIN = "2468"
SETTINGS = 'address = "https://reader.example.org/inbox"\ntoken = "send.token"\nanswer_s = 12.5\n'
NAMES = re.compile(r"\d{8}T\d{6}-(?:(?:OD|OS)-)?[0-9a-f]{6}")
DIGEST = re.compile(r"\b[0-9a-f]{64}\b")


# Writing


def make(folder: Path) -> None:
    """Write every file with the present code; `folder` must not be there yet."""
    folder.mkdir(parents=True)
    _make_data(folder)
    archive = Archive(folder / "calibrations")
    archive.keep(calibration(65.0), WHO)
    archive.keep(calibration(), WHO)
    new_key(folder / "key", "Golden record")
    export(archive.files(archive.current()), folder / "sent.calibration", folder / "key")
    (folder / "send.toml").write_text(SETTINGS, encoding="utf-8")
    (folder / "update").mkdir()
    state = {"state": "installed", "version": "0.2.0", "before": "0.1.0", "share": 1.0, "ill": ("clock",)}
    Journal(folder / "update").write(**state, spent_s=61.5, took_s=140.0)
    trouble = Trouble(code="update.failed", message="the page does not answer", remedy="Call the technician.")
    Journal(folder / "update").write(trouble=trouble)
    for lock in folder.rglob(".lock"):
        lock.unlink()


def _make_data(folder: Path) -> None:
    """Write the data folder: a sent visit, an open one, one that waits to be sent, a test picture, a torn capture."""
    with TemporaryDirectory() as place, ExitStack() as undo:
        head = Path(place) / "small.toml"
        head.write_text(SMALL_HEAD)
        spec = load_head(head)
        tiny = {"rows": 90, "cols": 160, "pitch_um": 3 * spec.camera.pitch_um}
        spec = spec.model_copy(update={"camera": spec.camera.model_copy(update=tiny)})
        clock = GateClock()
        clock.start = NOON
        rig = builder(traced(spec), Path(place) / "plans")(Path(place), undo, clock=clock)
        _visits(rig)
        rig.owner.close()
        ledger = LightBook(rig.store.engine, clock, DAY_S, boot="once")
        ledger.reserve(("OS",), 0.001, 0.1)  # never settled: the process was killed
        Underway(rig.store).begin(Lost("20260302T120500-OS-abcdef", "OS", "v", "L-nerve", 1), "0" * 16)
        Explorer(rig.store.folder / "explorer", Path(place), clock, spec, lambda *_, **__: None).choose("best")
        Door(rig.store.folder / "technician.json", clock).set_pin(PIN, None)
        visit = next(one for one in rig.request("GET", "/api/visits").json()["visits"] if one["number"] == "B-7")
        (folder / "export.zip").write_bytes(rig.request("GET", f"/api/visits/{visit['id']}/export.zip").content)
        rig.store.close()
        torn = rig.store.folder / "captures" / ".20260302T120600-OD-fedcba.part"
        torn.mkdir()
        (torn / "raw.tiff").write_bytes(b"half of a frame")
        shutil.copytree(rig.store.folder, folder / "data")


def _visits(rig: Rig) -> None:
    keys = (f"{number:016x}" for number in range(1, 1000))

    def ask(method: str, path: str, **order: Any) -> dict[str, Any]:
        answer = rig.request(method, f"/api/{path}", json={"key": next(keys), **order})
        assert answer.status_code in (200, 201), answer.text
        rig.clock.sleep(60)
        return dict(answer.json())

    def begun(**said: Any) -> str:
        number = said.pop("number", None)
        id = str(ask("POST", "visits", **({"number": number} if number else {}))["id"])
        for name, value in said.items():
            ask("PATCH", f"visits/{id}", field=name, value=value)
        return f"visits/{id}"

    def pressed(at: str, *slots: str) -> str:
        for slot in slots:
            eye = "OD" if slot.startswith("R") else "OS"
            made = ask("POST", "captures", eye=eye, visit=at.removeprefix("visits/"), slot=slot)
        return str(made["id"])

    known = {"name": "Meena K.", "village": "Nowhere", "phone": "12345", "age": 54, "vision_od": "6/9"}
    sent = begun(consent="agreed", **known)
    pressed(sent, "R-centre", "R-nerve", "R-centre")
    ask("POST", f"{sent}/could-not", slot="L-centre", reason="cloudy")
    ask("POST", f"{sent}/finish")
    still_open = begun(number="B-7", consent="agreed", complaints=["pain"])
    moved = pressed(still_open, "L-centre")
    ask("POST", f"captures/{moved}/eye", eye="OD")
    waits = begun(consent="declined")
    ask("POST", f"{waits}/finish")
    ask("POST", "captures", eye="OS")
    until(lambda: not rig.exam.fitness.due)
    outbox = Outbox(rig.store.engine, rig.clock)
    first, second = outbox.waiting()
    outbox.failed([first, second], SendUnreachable("the receiver answers 503"))
    outbox.arrived(first, Receipt("5a" * 32, "sha256"))


# Reading


def read_all(folder: Path) -> dict[str, Any]:
    """Return what the present code reads from a copy of these files; times are UTC, names are as kept."""
    clock = VirtualClock(LATER)
    with Store(folder / "data", reserve_bytes=0, clock=clock) as store:
        found = {
            "store": _read_store(store),
            "visits": _read_visits(store, clock),
            "uploads": _read_uploads(store, clock),
            "interrupted": [asdict(one) for one in Underway(store).lost],
            "spent_j_per_cm2": _read_doses(store),
        }
    return found | {
        "settings": _read_settings(folder, clock),
        "calibrations": _read_calibrations(folder),
        "update": read_entry(folder / "update").model_dump(mode="json", exclude={"boot"}),
    }


def _read_store(store: Store) -> dict[str, Any]:
    kept = [
        {
            "id": one.id, "eye": one.eye, "taken_at": one.taken_at.isoformat(), "simulated": one.simulated,
            "calibration": one.calibration_id, "report": one.report, "files": dict(one.files),
            "sizes": {name: len(store.read(one.id, name)) for name in one.files},
        }
        for one in store.captures()
    ]  # fmt: skip
    return {"captures": kept, "damaged": store.damaged(), "torn": list(store.torn()), "orphans": store.orphans()}


def _read_visits(store: Store, clock: VirtualClock) -> dict[str, Any]:
    people = People(store.engine, load_protocol(), clock)
    visits = [shown_visit(one, people) for one in people.visits(50)]
    exports = {}
    for one in people.visits(50):
        name = folder_name(one)
        content = zipped(name, exported(store, one, shown_visit(one, people)), one.begun_at)
        exports[one.number] = hashlib.sha256(content).hexdigest()
    return {"visits": visits, "counts": people.counts(), "damaged": people.damaged(), "exports": exports}


def _read_uploads(store: Store, clock: VirtualClock) -> dict[str, Any]:
    outbox = Outbox(store.engine, clock)
    waiting = [
        {
            "visit": one.visit, "number": one.number, "finished_at": one.finished_at.isoformat(), "tries": one.tries,
            "failing_since": one.failing_since and one.failing_since.isoformat(), "error": one.error,
            "said": one.said, "stuck": one.stuck, "size_bytes": one.size_bytes,
        }
        for one in outbox.waiting(sizes=True)
    ]  # fmt: skip
    trouble = outbox.trouble()
    return {"waiting": waiting, "numbers": [trouble.waiting, trouble.stuck, trouble.failing]}


def _read_doses(store: Store) -> dict[str, float]:
    """Return the doses as the process after a restart counts them, before any slot is too old."""
    ledger = LightBook(store.engine, VirtualClock(), DAY_S, boot="another")
    return {eye: float(f"{ledger.spent_j_per_cm2(eye):.9g}") for eye in ("OD", "OS")}


def _read_settings(folder: Path, clock: VirtualClock) -> dict[str, Any]:
    door = Door(folder / "data" / "technician.json", clock)
    try:
        door.unlock(PIN[::-1])
    except PinWrong as wrong:
        refused = wrong.code
    clock.sleep(10)
    door.unlock(PIN)
    spec = load_head(Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml")
    chosen = Explorer(folder / "data" / "explorer", folder, clock, spec, lambda *_, **__: None)
    send = load_settings(folder / "send.toml")
    return {
        "wrong pin": refused, "pace": chosen.pace, "budget_s": chosen.budget_s,
        "send": {"address": send.address, "token": str(send.token), "answer_s": send.answer_s, "most_s": send.most_s},
    }  # fmt: skip


def _read_calibrations(folder: Path) -> dict[str, Any]:
    archive, found = Archive(folder / "calibrations"), {}
    for id in sorted(archive.ids()):
        kept = archive.load(id)
        maps = {name: getattr(kept.calibration, name) for name in ("dark_dn", "flat", "bad")}
        found[id] = {
            "psfs": [[psf.name, psf.colour, digest(psf.pixels.tobytes())] for psf in kept.calibration.psfs],
            "maps": {name: digest(pixels.tobytes()) for name, pixels in maps.items()},
            "serial": kept.provenance.serial, "made_by": kept.provenance.made_by,
            "made_at": kept.provenance.made_at.isoformat(), "temperature_c": kept.provenance.temperature_c,
            "figures": [list(one) for one in kept.provenance.figures], "field_deg": kept.calibration.field_deg,
            "black_dn": kept.calibration.sensor.black_dn, "pitch_um": kept.calibration.geometry.pitch_um,
        }  # fmt: skip
    files, signer = read_export(folder / "sent.calibration", (read_signer(folder / "key.pub"),))
    signed = {"files": {name: digest(content) for name, content in files.items()}, "signer": signer.name}
    return {"kept": found, "in force": archive.current(), "signed": signed}


def digest(content: bytes) -> str:
    """Return the SHA-256 in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


# Writing again what was read


def written_again(folder: Path, place: Path) -> dict[str, bool]:
    """Return for each file that is a function of what was read whether the present code writes the same bytes."""
    clock = VirtualClock(LATER)
    archive, again = Archive(folder / "calibrations"), Archive(place / "again")
    id = archive.current()
    kept = archive.load(id)
    again.keep(kept.calibration, kept.provenance)
    export(archive.files(id), place / "sent", folder / "key")
    write_entry(place, read_entry(folder / "update"))
    with Store(folder / "data", reserve_bytes=0, clock=clock) as store:
        people = People(store.engine, load_protocol(), clock)
        (visit,) = (one for one in people.visits(50) if one.number == "B-7")
        name = folder_name(visit)
        zip_bytes = zipped(name, exported(store, visit, shown_visit(visit, people)), visit.begun_at)
        lost = Underway(store).lost[0]
        note = store.folder / "underway" / f"{lost.id}.json"
        before = note.read_bytes()
        note.unlink()
        Underway(store).begin(lost, "0" * 16)
        journal = note.read_bytes() == before
    return {
        "calibration": again.files(id) == archive.files(id),
        "signed file": (place / "sent").read_bytes() == (folder / "sent.calibration").read_bytes(),
        "export": zip_bytes == (folder / "export.zip").read_bytes(),
        "journal of interrupted captures": journal,
        "state of an update": (place / JOURNAL).read_bytes() == (folder / "update" / JOURNAL).read_bytes(),
    }


# The shape of what is written: everything but what chance or the solver decides


def shape(folder: Path) -> dict[str, Any]:
    """Return names of files and rows of tables; names of captures and visits by their order, digests left out."""
    names = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    names = [name for name in names if not name.endswith((".lock", "-wal", "-shm"))]
    with closing(sqlite3.connect(folder / "data" / "shelf.sqlite")) as tables:
        every = tables.execute("SELECT name FROM sqlite_schema WHERE type = 'table' ORDER BY name").fetchall()
        rows = {name: _rows(tables, name) for (name,) in every if not name.startswith("sqlite_")}
    return numbered({"tables": rows, "files": names})


def _rows(tables: sqlite3.Connection, name: str) -> list[dict[str, Any]]:
    found = tables.execute(f"SELECT * FROM {name} ORDER BY rowid")
    columns = [column[0] for column in found.description]
    return [{column: _plain(column, value) for column, value in zip(columns, row, strict=True)} for row in found]


def _plain(column: str, value: Any) -> Any:
    """Return a value of a row: of a report its keys, of a file no length, of a dose nine digits."""
    if column == "report":
        return keys_of(json.loads(value))
    if column == "bytes":
        return None
    return float(f"{value:.6g}") if isinstance(value, float) else value


def keys_of(value: Any) -> Any:
    """Return the keys of nested JSON, with the type of each value."""
    return {key: keys_of(one) for key, one in value.items()} if isinstance(value, dict) else type(value).__name__


def numbered(value: Any) -> Any:
    """Return the same with names of captures and visits replaced in order of appearance, and digests by a word."""
    text = DIGEST.sub("sha256", json.dumps(value))
    for number, name in enumerate(dict.fromkeys(NAMES.findall(text)), 1):
        text = text.replace(name, f"name-{number}")
    return json.loads(text)


def schema(folder: Path) -> str:
    """Return the statements of the tables and indices of a data folder, sorted, as text."""
    with closing(sqlite3.connect(folder / "data" / "shelf.sqlite")) as tables:
        found = tables.execute("SELECT sql FROM sqlite_schema WHERE sql IS NOT NULL ORDER BY type, name").fetchall()
    return "".join(f"{statement.strip()};\n\n" for (statement,) in found)


def write() -> Path:
    """Write all files anew, and the record of what is read from them."""
    shutil.rmtree(KEPT, ignore_errors=True)
    make(KEPT)
    with TemporaryDirectory() as place:
        copy = Path(shutil.copytree(KEPT, Path(place) / "copy"))
        SCHEMA.write_text(schema(copy), encoding="utf-8")
        shapes = shape(copy)
        compare.write("files", {"read": read_all(copy), "shape": shapes})
    return KEPT
