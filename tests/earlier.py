"""SQL statements of earlier releases, one set for each version of the tables.

The statements were recorded from the releases and never change: newer tables must still accept them, because an update
may be rolled back. A new version of the tables adds the statements of its own release.
"""

import hashlib
import json
import sqlite3
from collections.abc import Callable
from pathlib import Path

from alembic import command

from services.records import schema

RAW = b"raw counts"
OUTCOME = '{"code": "refer_picture", "sentence": "Refer: picture of both eyes not possible."}'
Row = tuple[object, ...]
_CAPTURE = "captures.id, captures.eye, captures.taken_at, captures.simulated, captures.calibration_id, captures.report"
_VISIT = "visits.id, visits.person, visits.day, visits.begun_at, visits.finished_at, visits.outcome"
_SENDING = (
    "sendings.visit, sendings.finished_at, sendings.tries, sendings.failing_since, sendings.error, sendings.said,"
    " sendings.sent_at, sendings.sha256, sendings.confirmed"
)
_FIELD = "fields.visit, fields.name, fields.value, fields.set_at"


def store_of_version(folder: Path, version: str) -> Path:
    """Create an empty store whose tables have that version; return its folder."""
    (folder / "captures").mkdir(parents=True)
    engine = schema.open_engine(folder / "shelf.sqlite")
    config = schema.migration_config()
    with schema.for_writing(engine).begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, version)
    engine.dispose()
    return folder


class Release:
    """Program of an earlier release: its connection, its write statements for number `n`, its queries."""

    def __init__(self, folder: Path, version: str) -> None:
        self._folder = folder
        self._versions = sorted(known for known in WRITES if known <= version)

    def write(self, n: int) -> None:
        """Run every write statement of the release, with names that end in `n`, and write a file of a capture."""
        capture_folder = self._folder / "captures" / f"c{n}"
        capture_folder.mkdir()
        (capture_folder / "raw.tiff").write_bytes(RAW)
        with self._connected() as connection:
            connection.execute("BEGIN IMMEDIATE")
            for version in self._versions:
                WRITES[version](connection, n)
            connection.execute("COMMIT")
        connection.close()

    def read(self, n: int) -> list[list[Row]]:
        """Return the result of each query of the release about number `n`."""
        with self._connected() as connection:
            results = [
                connection.execute(*query).fetchall() for version in self._versions for query in READS[version](n)
            ]
        connection.close()
        return results

    def _connected(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self._folder / "shelf.sqlite", isolation_level=None)
        for pragma in ("journal_mode = WAL", "synchronous = FULL", "foreign_keys = ON"):
            connection.execute(f"PRAGMA {pragma}")
        return connection


def _write_captures(connection: sqlite3.Connection, n: int) -> None:
    connection.execute(
        "INSERT INTO captures (id, eye, taken_at, simulated, calibration_id, report) VALUES (?, ?, ?, ?, ?, ?)",
        (f"c{n}", "OD", f"2026-03-01T12:00:{n:02}.000000+00:00", 1, "00ff", json.dumps({"verdict": {"n": n}})),
    )
    digest = hashlib.sha256(RAW).hexdigest()
    connection.execute(
        "INSERT INTO files (capture_id, name, sha256, bytes) VALUES (?, ?, ?, ?)",
        (f"c{n}", "raw.tiff", digest, len(RAW)),
    )


def _read_captures(n: int) -> list[tuple[str, Row]]:
    since = (f"2026-03-01T12:00:{n + 1:02}.000000+00:00", "", 1, 0)
    return [
        (
            f"SELECT {_CAPTURE} FROM captures WHERE (captures.taken_at, captures.id) < (?, ?)"
            " ORDER BY captures.taken_at DESC, captures.id DESC LIMIT ? OFFSET ?",
            since,
        ),
        (f"SELECT {_CAPTURE} FROM captures WHERE captures.id = ?", (f"c{n}",)),
        (
            "SELECT files.capture_id, files.name, files.sha256, files.bytes FROM files WHERE files.capture_id IN (?)"
            " ORDER BY files.name",
            (f"c{n}",),
        ),
    ]


def _write_light(connection: sqlite3.Connection, n: int) -> None:
    connection.execute("INSERT INTO light_doses (eye, slot, dose_j_per_cm2) VALUES (?, ?, ?)", ("OD", n, 0.001))
    connection.execute(
        "UPDATE light_doses SET dose_j_per_cm2=? WHERE light_doses.eye = ? AND light_doses.slot = ?", (n, "OD", n)
    )
    connection.execute("INSERT INTO light_doses (eye, slot, dose_j_per_cm2) VALUES (?, ?, ?)", ("OS", n, 0.001))
    connection.execute("DELETE FROM light_doses WHERE light_doses.eye = ? AND light_doses.slot = ?", ("OS", n))
    if (
        connection.execute(
            "UPDATE light_time SET now_s=?, observed_s=? WHERE light_time.id = ?", (1.0, 2.0, 1)
        ).rowcount
        == 0
    ):
        connection.execute(
            "INSERT INTO light_time (id, boot, now_s, observed_s) VALUES (?, ?, ?, ?)", (1, "boot", 1.0, 2.0)
        )


def _read_light(n: int) -> list[tuple[str, Row]]:
    return [
        (
            "SELECT light_doses.eye, light_doses.slot, light_doses.dose_j_per_cm2 FROM light_doses"
            " WHERE light_doses.eye = ? AND light_doses.slot = ?",
            ("OD", n),
        ),
        ("SELECT light_time.id, light_time.boot, light_time.now_s, light_time.observed_s FROM light_time", ()),
    ]


def _write_people(connection: sqlite3.Connection, n: int) -> None:
    now, visit, person = "2026-03-01T12:00:00.000000+00:00", f"v{n}", f"A{n}"
    connection.execute("DELETE FROM keys WHERE keys.done_at < ?", ("2026-01-01",))
    if connection.execute("UPDATE counters SET last=? WHERE counters.prefix = ?", (n, "A")).rowcount == 0:
        connection.execute("INSERT INTO counters (prefix, last) VALUES (?, ?)", ("A", n))
    connection.execute("INSERT INTO persons (number, made_at) VALUES (?, ?)", (person, now))
    connection.execute(
        'INSERT INTO keys ("key", request, answer, done_at) VALUES (?, ?, ?, ?)', (f"{n:016}", "r", visit, now)
    )
    connection.execute(
        "INSERT INTO visits (id, person, day, begun_at, finished_at, outcome) VALUES (?, ?, ?, ?, ?, ?)",
        (visit, person, "2026-03-01", now, None, None),
    )
    connection.execute("INSERT INTO fields (visit, name, value, set_at) VALUES (?, ?, ?, ?)", (visit, "age", "50", now))
    connection.execute(
        "UPDATE fields SET value=?, set_at=? WHERE fields.visit = ? AND fields.name = ?", ("51", now, visit, "age")
    )
    connection.execute("INSERT INTO identifiers (person, name, value) VALUES (?, ?, ?)", (person, "name", '"x"'))
    connection.execute(
        "DELETE FROM identifiers WHERE identifiers.person = ? AND identifiers.name = ?", (person, "name")
    )
    connection.execute("INSERT INTO shots (capture, visit, slot) VALUES (?, ?, ?)", (f"c{n}", visit, "R-centre"))
    connection.execute(
        "INSERT INTO slots (visit, slot, capture, reason) VALUES (?, ?, ?, ?)", (visit, "L-centre", None, "pupil")
    )
    connection.execute(
        "UPDATE slots SET reason=? WHERE slots.visit = ? AND slots.slot = ?", ("pain", visit, "L-centre")
    )
    connection.execute(
        "UPDATE visits SET finished_at=?, outcome=? WHERE visits.id = ?",
        (now, OUTCOME, visit),
    )


def _read_people(n: int) -> list[tuple[str, Row]]:
    visit, person = f"v{n}", f"A{n}"
    return [
        ('SELECT keys."key", keys.request, keys.answer, keys.done_at FROM keys WHERE keys."key" = ?', (f"{n:016}",)),
        ("SELECT persons.number, persons.made_at FROM persons WHERE persons.number = ?", (person,)),
        (f"SELECT {_VISIT} FROM visits WHERE visits.id = ?", (visit,)),
        (
            "SELECT fields.visit, fields.name, fields.value, fields.set_at FROM fields WHERE fields.visit IN (?)",
            (visit,),
        ),
        (
            "SELECT identifiers.person, identifiers.name, identifiers.value FROM identifiers"
            " WHERE identifiers.person IN (?)",
            (person,),
        ),
        (
            "SELECT shots.visit, shots.slot, shots.capture, json_extract(captures.report, ?) AS json_extract_1"
            " FROM shots JOIN captures ON captures.id = shots.capture WHERE shots.visit IN (?)"
            " ORDER BY captures.taken_at, captures.id",
            ("$.verdict", visit),
        ),
        ("SELECT slots.visit, slots.slot, slots.capture, slots.reason FROM slots WHERE slots.visit IN (?)", (visit,)),
    ]


def _write_outbox(connection: sqlite3.Connection, n: int) -> None:
    now, visit = "2026-03-01T12:00:00.000000+00:00", f"v{n}"
    connection.execute(
        "INSERT INTO sendings (visit, finished_at, tries, failing_since, error, said, sent_at, sha256, confirmed)"
        " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (visit, now, 1, now, "send.link", "no answer", None, None, None),
    )
    connection.execute(
        "UPDATE sendings SET tries=?, failing_since=?, error=?, said=?, sent_at=?, sha256=?, confirmed=?"
        " WHERE sendings.visit = ? AND sendings.finished_at = ?",
        (2, None, None, None, now, hashlib.sha256(RAW).hexdigest(), "sha256", visit, now),
    )
    connection.execute("UPDATE visits SET sent=? WHERE visits.id = ?", (now, visit))


def _read_outbox(n: int) -> list[tuple[str, Row]]:
    visit = f"v{n}"
    return [
        (f"SELECT {_VISIT}, visits.sent FROM visits WHERE visits.id = ?", (visit,)),
        (f"SELECT {_SENDING} FROM sendings WHERE sendings.visit = ?", (visit,)),
        (
            "SELECT visits.id FROM visits WHERE visits.id = ? AND visits.finished_at IS NOT NULL"
            " AND (visits.sent IS NULL OR visits.sent != visits.finished_at)",
            (visit,),
        ),
    ]


def _correct_eye(connection: sqlite3.Connection, n: int) -> None:
    report = {"verdict": {"n": n}, "visit": f"v{n}", "slot": "R-nerve", "laterality": {"eye": "OD"}}
    connection.execute("UPDATE captures SET eye=?, report=? WHERE captures.id = ?", ("OD", json.dumps(report), f"c{n}"))
    connection.execute("UPDATE shots SET slot=? WHERE shots.capture = ?", ("R-nerve", f"c{n}"))


def _read_columns(n: int) -> list[tuple[str, Row]]:
    return [
        (
            "SELECT captures.visit, captures.slot, captures.verdict, captures.laterality FROM captures"
            " WHERE captures.id = ?",
            (f"c{n}",),
        ),
        (
            "SELECT shots.visit, coalesce(captures.slot, shots.slot) AS coalesce_1, shots.capture, captures.verdict"
            " FROM shots LEFT OUTER JOIN captures ON captures.id = shots.capture WHERE shots.visit IN (?)"
            " ORDER BY captures.rowid",
            (f"v{n}",),
        ),
    ]


def _sign_records(connection: sqlite3.Connection, n: int) -> None:
    reference = f"{n:016x} {hashlib.sha256(b'press').hexdigest()}"
    connection.execute("UPDATE captures SET request=? WHERE captures.id = ?", (reference, f"c{n}"))
    connection.execute("UPDATE visits SET request=? WHERE visits.id = ?", (reference, f"v{n}"))
    connection.execute("UPDATE persons SET patient_id=? WHERE persons.number = ?", (f"{n:016x}", f"A{n}"))
    row = connection.execute(f"SELECT {_CAPTURE} FROM captures WHERE captures.id = ?", (f"c{n}",)).fetchone()
    names = ("id", "eye", "taken_at", "simulated", "calibration_id")
    content = dict(zip(names, row, strict=False)) | {"report": json.loads(row[5]), "request": reference}
    content["files"] = {"raw.tiff": {"sha256": hashlib.sha256(RAW).hexdigest(), "bytes": len(RAW)}}
    signed = {"kind": "capture", "revision": 1, "record": content}
    digest = hashlib.sha256(json.dumps(signed, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
    connection.execute("UPDATE captures SET revision=?, record_sha256=? WHERE captures.id = ?", (1, digest, f"c{n}"))


def _read_records(n: int) -> list[tuple[str, Row]]:
    return [
        ("SELECT captures.id FROM captures WHERE captures.record_sha256 IS NULL", ()),
        ("SELECT captures.request, captures.revision FROM captures WHERE captures.id = ?", (f"c{n}",)),
        ("SELECT visits.request FROM visits WHERE visits.id = ?", (f"v{n}",)),
        ("SELECT persons.number, persons.patient_id FROM persons WHERE persons.number IN (?)", (f"A{n}",)),
    ]


WRITES: dict[str, Callable[[sqlite3.Connection, int], None]] = {
    "r0001": _write_captures,
    "r0002": _write_light,
    "r0003": _write_people,
    "r0004": _write_outbox,
    "r0005": _correct_eye,
    "r0006": _sign_records,
}
READS: dict[str, Callable[[int], list[tuple[str, Row]]]] = {
    "r0001": _read_captures,
    "r0002": _read_light,
    "r0003": _read_people,
    "r0004": _read_outbox,
    "r0005": _read_columns,
    "r0006": _read_records,
}
