"""SQLite schema of the capture store: tables, connections (WAL, synchronous=FULL), migrations, conversion to rows."""

import json
import math
import os
import stat
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import (
    REAL,
    URL,
    CheckConstraint,
    ColumnElement,
    Computed,
    Connection,
    Engine,
    ForeignKey,
    Index,
    Integer,
    SQLColumnExpression,
    Text,
    case,
    create_engine,
    event,
    func,
    literal_column,
    text,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column, relationship
from sqlalchemy.pool import ConnectionPoolEntry

from device import atomic_io
from device.errors import SettingError, StoreError
from services.records.capture import Capture, CaptureReport
from services.records.earlier_stores import refuse_earlier_tables
from services.records.json_values import JsonValue

DATABASE = "store.sqlite"
MIGRATIONS = Path(__file__).parent / "migrations"

# WAL with FULL is the fastest pair that lost no acknowledged row in power-cut trials; NORMAL lost the last ones.
BUSY_MS, CHECKPOINT_BUSY_MS = 5000, 200  # a writer waits; a checkpoint gives up and is retried later
PROBE_BUSY_MS = 1000  # of a health check: longer than our own transactions
PRAGMAS = (
    f"PRAGMA busy_timeout = {BUSY_MS}",
    "PRAGMA journal_mode = WAL",
    "PRAGMA synchronous = FULL",
    "PRAGMA foreign_keys = ON",
)


SCHEMA_TEXT = "SELECT name, sql FROM sqlite_schema"


class Base(DeclarativeBase):
    """Declarative base of all tables."""


def _report_entry(name: str, kind: str) -> Computed:
    """Return the generated column of an entry of the report with that JSON type; null for another type or damage."""
    entry = f"CASE json_type(report, '$.{name}') WHEN '{kind}' THEN json_extract(report, '$.{name}') END"
    return Computed(f"CASE WHEN json_valid(report) THEN {entry} END", persisted=False)


UNSIGNED = "record_sha256 IS NULL"


class RecordColumns:
    """Columns of the row of a record: its revision and digest (record_document.py).

    A trigger makes `record_sha256` null when a value of the record is changed, until the record is signed again
    (record_signing.py).
    """

    revision: Mapped[int] = mapped_column(server_default="0")
    record_sha256: Mapped[str | None] = mapped_column(Text)


class CaptureRow(RecordColumns, Base):
    """One stored capture; `report` is JSON, `simulated` 0 or 1.

    `taken_at` is UTC text with six decimals of the second, so that text order is time order. SQLite computes `visit`,
    `slot`, `verdict` and `laterality` (the last two JSON objects) from the report: they stand in one place.
    `request`: idempotency key of its press and SHA-256 of that request, or null.
    """

    __tablename__ = "captures"
    __mapper_args__: Mapping[str, bool] = {"eager_defaults": False}  # an insert reads no generated column back

    id: Mapped[str] = mapped_column(Text, primary_key=True)
    eye: Mapped[str] = mapped_column(Text)
    taken_at: Mapped[str] = mapped_column(Text)
    simulated: Mapped[int]
    calibration_id: Mapped[str] = mapped_column(Text)
    report: Mapped[str] = mapped_column(Text)
    visit: Mapped[str | None] = mapped_column(Text, _report_entry("visit", "text"))
    slot: Mapped[str | None] = mapped_column(Text, _report_entry("slot", "text"))
    verdict: Mapped[str | None] = mapped_column(Text, _report_entry("verdict", "object"))
    laterality: Mapped[str | None] = mapped_column(Text, _report_entry("laterality", "object"))
    request: Mapped[str | None] = mapped_column(Text)
    files: Mapped[list["FileRow"]] = relationship(order_by="FileRow.name")

    __table_args__ = (
        CheckConstraint("eye IN ('OD', 'OS')", name="eye_is_an_eye"),
        CheckConstraint("simulated IN (0, 1)", name="simulated_is_yes_or_no"),
        CheckConstraint("json_valid(report)", name="report_is_json"),
        Index("captures_by_time", "taken_at", "id"),
        Index("captures_to_sign", "id", sqlite_where=text(UNSIGNED)),
        {"sqlite_strict": True},
    )


CAPTURE_ROWID = literal_column("captures.rowid", Integer).label(
    "kept"
)  # grows with each stored capture, independently of the clock


class FileRow(Base):
    """One stored file of a capture: name, SHA-256 in hexadecimal digits, and length in bytes."""

    __tablename__ = "files"

    capture_id: Mapped[str] = mapped_column(Text, ForeignKey("captures.id"), primary_key=True)
    name: Mapped[str] = mapped_column(Text, primary_key=True)
    sha256: Mapped[str] = mapped_column(Text)
    bytes: Mapped[int]

    __table_args__ = (
        CheckConstraint("length(sha256) = 64", name="sha256_is_whole"),
        CheckConstraint("bytes >= 0", name="bytes_is_a_length"),
        {"sqlite_strict": True},
    )


class DoseRow(Base):
    """Dose (J/cm2) of one eye in one interval of observed time, including reservations that were not settled.

    `interval`: number of the interval, counted in INTERVAL_S from observed time 0.
    """

    __tablename__ = "doses"

    eye: Mapped[str] = mapped_column(Text, primary_key=True)
    interval: Mapped[int] = mapped_column(primary_key=True)
    dose_j_per_cm2: Mapped[float] = mapped_column(REAL)

    __table_args__ = (
        CheckConstraint("eye IN ('OD', 'OS')", name="dose_is_of_an_eye"),
        CheckConstraint("dose_j_per_cm2 >= 0", name="dose_is_not_negative"),
        {"sqlite_strict": True},
    )


class ObservedTimeRow(Base):
    """Observed time of the dose ledger, by which doses expire; a table of one row.

    `boot` and `now_s`: boot id and monotonic time (s) of the last observation; `observed_s`: total observed time (s).
    """

    __tablename__ = "observed_time"

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    boot: Mapped[str] = mapped_column(Text)
    now_s: Mapped[float] = mapped_column(REAL)
    observed_s: Mapped[float] = mapped_column(REAL)

    __table_args__ = (CheckConstraint("id = 1", name="time_is_one_row"), {"sqlite_strict": True})


class PatientRow(RecordColumns, Base):
    """One patient: opaque random id, time of creation (UTC), `identity`: number etc. (`PatientIndex.encrypted`)."""

    __tablename__ = "patients"

    patient_id: Mapped[str] = mapped_column(Text, primary_key=True)
    made_at: Mapped[str] = mapped_column(Text)
    identity: Mapped[str] = mapped_column(Text)

    __table_args__ = (
        Index("patients_to_sign", "patient_id", sqlite_where=text(UNSIGNED)),
        {"sqlite_strict": True},
    )


NOT_UPLOADED = "finished_at IS NOT NULL AND (sent IS NULL OR sent <> finished_at)"


class VisitRow(RecordColumns, Base):
    """One visit of the patient with the id `patient`; `day` is the local date of its start, timestamps are UTC.

    `finished_at` and `outcome` (JSON) are null in an unfinished visit. `request`: idempotency key of the request that
    began it and SHA-256 of that request, or null.
    """

    __tablename__ = "visits"

    id: Mapped[str] = mapped_column(Text, primary_key=True)
    patient: Mapped[str] = mapped_column(Text, ForeignKey("patients.patient_id"))
    day: Mapped[str] = mapped_column(Text)
    begun_at: Mapped[str] = mapped_column(Text)
    finished_at: Mapped[str | None] = mapped_column(Text)
    outcome: Mapped[str | None] = mapped_column(Text)
    sent: Mapped[str | None] = mapped_column(Text)  # the `finished_at` of the last uploaded state
    request: Mapped[str | None] = mapped_column(Text)

    __table_args__ = (
        CheckConstraint("(finished_at IS NULL) = (outcome IS NULL)", name="finished_has_an_outcome"),
        CheckConstraint("outcome IS NULL OR json_valid(outcome)", name="outcome_is_json"),
        Index("visits_by_time", "begun_at", "id"),
        Index("visits_by_day", "day"),
        Index("visits_to_sign", "id", sqlite_where=text(UNSIGNED)),
        Index(
            "visits_to_upload", "finished_at", sqlite_where=text(NOT_UPLOADED)
        ),  # partial index: only visits in the upload queue
        {"sqlite_strict": True},
    )


VISIT_ROWID = literal_column("visits.rowid", Integer)  # grows with each begun visit, independently of the clock


class AnswerRow(Base):
    """One answer of a visit to the form field `name`; `value` is JSON, `set_at` the UTC time of the answer."""

    __tablename__ = "answers"

    visit: Mapped[str] = mapped_column(Text, ForeignKey("visits.id"), primary_key=True)
    name: Mapped[str] = mapped_column(Text, primary_key=True)
    value: Mapped[str] = mapped_column(Text)
    set_at: Mapped[str] = mapped_column(Text)

    __table_args__ = (
        CheckConstraint("json_valid(value)", name="answer_is_json"),
        CheckConstraint("length(value) <= 2000", name="answer_is_short"),
        {"sqlite_strict": True},
    )


class ChangeRow(Base):
    """One change of a visit, number 1 first: time (UTC), user ("" for the device), form field, `outcome`, `laterality`.

    `was` and `value` (JSON): before and after, those of an identifying field as the text of `PatientIndex.encrypted`;
    `why`: reason of a reopening, or null. Rows are only added.
    """

    __tablename__ = "changes"

    visit: Mapped[str] = mapped_column(Text, ForeignKey("visits.id"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    at: Mapped[str] = mapped_column(Text)
    user: Mapped[str] = mapped_column(Text)
    field: Mapped[str] = mapped_column(Text)
    was: Mapped[str] = mapped_column(Text)
    value: Mapped[str] = mapped_column(Text)
    why: Mapped[str | None] = mapped_column(Text)

    __table_args__ = (
        CheckConstraint("json_valid(was) AND json_valid(value)", name="change_is_json"),
        {"sqlite_strict": True},
    )


class CaptureSlotRow(Base):
    """Visit and picture slot of a capture; a test picture has no such row."""

    __tablename__ = "capture_slots"

    capture: Mapped[str] = mapped_column(Text, ForeignKey("captures.id"), primary_key=True)
    visit: Mapped[str] = mapped_column(Text, ForeignKey("visits.id"))
    slot: Mapped[str] = mapped_column(Text)

    __table_args__ = (Index("capture_slots_by_visit", "visit"), {"sqlite_strict": True})


class SlotDecisionRow(Base):
    """Decision on one slot: the chosen `capture`, or the `reason` why no picture was possible, or neither (emptied)."""

    __tablename__ = "slot_decisions"

    visit: Mapped[str] = mapped_column(Text, ForeignKey("visits.id"), primary_key=True)
    slot: Mapped[str] = mapped_column(Text, primary_key=True)
    capture: Mapped[str | None] = mapped_column(Text, ForeignKey("captures.id"))
    reason: Mapped[str | None] = mapped_column(Text)

    __table_args__ = (
        CheckConstraint("capture IS NULL OR reason IS NULL", name="capture_or_reason"),
        {"sqlite_strict": True},
    )


class UploadRow(Base):
    """State of the upload of a visit as finished at `finished_at`; no row before the first attempt.

    `tries`: number of attempts; `failing_since`: time of the first failure; `error` and `message`: code and message
    of the last one, null after success. `sent_at`, `sha256`, `confirmed`: time of the upload, digest of the archive,
    method of the receiver's confirmation ("sha256", or "length" only); null before success.
    """

    __tablename__ = "uploads"

    visit: Mapped[str] = mapped_column(Text, ForeignKey("visits.id"), primary_key=True)
    finished_at: Mapped[str] = mapped_column(Text, primary_key=True)
    tries: Mapped[int]
    failing_since: Mapped[str | None] = mapped_column(Text)
    error: Mapped[str | None] = mapped_column(Text)
    message: Mapped[str | None] = mapped_column(Text)
    sent_at: Mapped[str | None] = mapped_column(Text)
    sha256: Mapped[str | None] = mapped_column(Text)
    confirmed: Mapped[str | None] = mapped_column(Text)

    __table_args__ = (
        CheckConstraint("tries >= 0", name="tries_are_not_negative"),
        CheckConstraint("(sent_at IS NULL) = (sha256 IS NULL)", name="sent_has_a_digest"),
        CheckConstraint("(sent_at IS NULL) = (confirmed IS NULL)", name="sent_has_a_confirmation"),
        {"sqlite_strict": True},
    )


class CounterRow(Base):
    """Counter of the last automatic patient number of a prefix, without check digit."""

    __tablename__ = "counters"

    prefix: Mapped[str] = mapped_column(Text, primary_key=True)
    last: Mapped[int]

    __table_args__ = (CheckConstraint("last >= 0", name="counter_is_not_negative"), {"sqlite_strict": True})


class IdempotencyKeyRow(Base):
    """Idempotency key of a completed request, with the SHA-256 of the request and the answer, such as a visit id."""

    __tablename__ = "idempotency_keys"

    key: Mapped[str] = mapped_column(Text, primary_key=True)
    request: Mapped[str] = mapped_column(Text)
    answer: Mapped[str] = mapped_column(Text)
    done_at: Mapped[str] = mapped_column(Text)

    __table_args__ = (
        CheckConstraint("length(key) = 16", name="key_is_whole"),
        Index("idempotency_keys_by_time", "done_at"),
        {"sqlite_strict": True},
    )


RecordRow = PatientRow | VisitRow | CaptureRow
RECORD_TABLES: dict[str, type[RecordRow]] = {
    "patient": PatientRow,
    "visit": VisitRow,
    "capture": CaptureRow,
}
RECORD_KEYS = {"patient": PatientRow.patient_id, "visit": VisitRow.id, "capture": CaptureRow.id}
SIGNED = {  # columns of the values of a record
    "patient": "patient_id, made_at, identity",
    "visit": "patient, day, begun_at, finished_at, outcome, sent, request",
    "capture": "eye, taken_at, simulated, calibration_id, report, request",
}
RECORD_OF_PART = {  # table of values of a record: the record, column with its key
    "files": ("capture", "capture_id"),
    "answers": ("visit", "visit"),
    "changes": ("visit", "visit"),
    "slot_decisions": ("visit", "visit"),
    "uploads": ("visit", "visit"),
}


def record_key(row: RecordRow) -> str:
    """Return the primary key of the row of a record: the id of the patient, the visit or the capture."""
    return row.patient_id if isinstance(row, PatientRow) else row.id


def _signing_triggers() -> Iterator[str]:
    """Yield the SQL of the triggers that make the digest of a record null when one of its values is changed.

    The revision of a visit shows that a capture of it was corrected.
    """
    for kind, table in RECORD_TABLES.items():
        name = table.__tablename__
        yield _trigger(f"{name}_changed", f"UPDATE OF {SIGNED[kind]} ON {name}", kind, f"NEW.{RECORD_KEYS[kind].key}")
    yield _trigger("captures_of_visit_changed", "UPDATE OF eye, report ON captures", "visit", "NEW.visit")
    for part, (kind, column) in RECORD_OF_PART.items():
        for change, row in (("INSERT", "NEW"), ("UPDATE", "NEW"), ("DELETE", "OLD")):
            sent_only = f" WHEN {row}.sent_at IS NOT NULL" if part == "uploads" else ""
            yield _trigger(f"{part}_{change.lower()}", f"{change} ON {part}{sent_only}", kind, f"{row}.{column}")


def _trigger(name: str, change: str, kind: str, key: str) -> str:
    table = RECORD_TABLES[kind].__tablename__
    body = f"UPDATE {table} SET record_sha256 = NULL WHERE {RECORD_KEYS[kind].key} = {key}"
    return f"CREATE TRIGGER {name} AFTER {change} BEGIN {body}; END"


def open_engine(path: Path, key: bytes | None = None) -> Engine:
    """Return an engine for one SQLite file, usable from any thread; transactions of `for_writing` are serialised.

    `key`: authenticates the files beside the tables, see `key_of`.

    The driver's own transaction handling is off: its commit before each schema change would split a migration.
    """
    engine = create_engine(URL.create("sqlite", database=str(path)), execution_options={"file_key": key})
    event.listen(engine, "connect", _prepare)
    event.listen(engine, "begin", _begin)
    return engine


def make_private(database: Path) -> None:
    """Make the file of a database, empty if it is missing, private; its logs get its mode. OSError if disk refuses."""
    with open(database, "ab", opener=atomic_io.private_opener) as file:
        if stat.S_IMODE(os.fstat(file.fileno()).st_mode) != atomic_io.PRIVATE_FILE:
            os.fchmod(file.fileno(), atomic_io.PRIVATE_FILE)


def folder_of(engine: Engine) -> Path:
    """Return the folder of the store whose tables these are."""
    return Path(str(engine.url.database)).parent


def key_of(engine: Engine) -> bytes | None:
    """Return the key that authenticates the files of the store whose tables these are; None without one."""
    key: bytes | None = engine.get_execution_options()["file_key"]
    return key


def _prepare(connection: Any, _entry: ConnectionPoolEntry) -> None:
    """Set up one new connection: no transaction handling by the driver, text decoding by `decoded`, PRAGMAS."""
    connection.isolation_level = None
    connection.text_factory = decoded
    for pragma in PRAGMAS:
        connection.execute(pragma).close()


def decoded(content: bytes) -> str:
    """Decode stored text; bytes that are not UTF-8 become lone surrogates, which row_validation refuses row by row."""
    return content.decode(errors="surrogateescape")


def _begin(connection: Connection) -> None:
    """Begin a transaction; with `for_writing` take the write lock at once: an upgrade of a read lock cannot wait."""
    writing = connection.get_execution_options().get("writing", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")


def refuse_changes(engine: Engine, refusal: StoreError) -> None:
    """Let `refuse_if_read_only` raise this error: the tables are a copy that ends with the program."""
    engine.update_execution_options(refusal=refusal)


def refuse_if_read_only(engine: Engine) -> None:
    """Raise the error given to `refuse_changes`, if there is one; to be called before a change is acknowledged."""
    refusal: StoreError | None = engine.get_execution_options().get("refusal")
    if refusal is not None:
        raise type(refusal)(refusal.message, refusal.remedy)


def for_writing(engine: Engine) -> Engine:
    """Return the engine with the option that makes its transactions take the write lock at the beginning."""
    return engine.execution_options(writing=True)


def checkpoint(engine: Engine) -> bool:
    """Write the rows of the write-ahead log into the main file, with fsync, and truncate the log; return True.

    Return False if another connection reads or writes longer than CHECKPOINT_BUSY_MS: then none or only some of the
    rows were written, and the log is not truncated.
    """
    with closing(
        engine.raw_connection()
    ) as pooled:  # `connect` would begin a transaction, in which a checkpoint is impossible
        connection: Any = pooled.driver_connection
        connection.execute(f"PRAGMA busy_timeout = {CHECKPOINT_BUSY_MS}").close()
        try:
            busy = connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()[0]
        finally:
            connection.execute(f"PRAGMA busy_timeout = {BUSY_MS}").close()
    return not busy


def lock_briefly(engine: Engine) -> None:
    """Take the write lock of the database and release it at once; an error of SQLite after PROBE_BUSY_MS without it."""
    with closing(engine.raw_connection()) as pooled:
        connection: Any = pooled.driver_connection
        connection.execute(f"PRAGMA busy_timeout = {PROBE_BUSY_MS}").close()
        try:
            connection.execute("BEGIN IMMEDIATE").close()
            connection.execute("ROLLBACK").close()
        finally:
            connection.execute(f"PRAGMA busy_timeout = {BUSY_MS}").close()


def migrate(engine: Engine, before: Callable[[str], None], migrations: Path = MIGRATIONS) -> None:
    """Migrate the tables to the schema of this release in one transaction; leave tables of a newer schema unchanged.

    Without tables, create those of this release. A newer schema is present after a rollback of an update. Releases only
    add to the schema (README), so this release works with a newer one. `before` is called with the present revision
    before the migration of existing tables; an exception of `before` cancels the migration. `migrations`: folder of the
    migrations. StoreError for tables of a version before the first release.
    """
    config = Config()
    config.set_main_option("script_location", str(migrations).replace("%", "%%"))
    scripts = ScriptDirectory.from_config(config)
    known = {script.revision for script in scripts.walk_revisions()}
    with engine.connect() as connection:
        present = set(MigrationContext.configure(connection).get_current_heads())
    for version in present:
        refuse_earlier_tables(version, str(folder_of(engine)))
    if not present <= known or present == set(scripts.get_heads()):
        return
    for version in present:
        before(version)
    with for_writing(engine).begin() as connection:
        config.attributes["connection"] = connection
        if present:
            command.upgrade(config, "head")
        else:
            Base.metadata.create_all(connection, checkfirst=False)
            for trigger in _signing_triggers():
                connection.exec_driver_sql(trigger)
            command.stamp(config, "head")
        tables = [tuple(row) for row in connection.exec_driver_sql(SCHEMA_TEXT)]
        connection.exec_driver_sql(f"PRAGMA user_version = {schema_checksum(tables)}")


def schema_checksum(tables: Sequence[tuple[str, str | None]]) -> int:
    """Return the checksum (31 bits, not 0) of the rows of SCHEMA_TEXT, stored as `user_version` of the database.

    A bit that changes in the SQL of a trigger or a constraint passes SQLite's integrity check.
    """
    return zlib.crc32(repr(sorted(tables, key=repr)).encode()) & 0x7FFFFFFF or 1


def utc_text(moment: datetime) -> str:
    """Return a timestamp as UTC text (ISO 8601, microseconds) that sorts by time; SettingError without a time zone."""
    if moment.tzinfo is None:
        raise SettingError(f"the time {moment} has no time zone, so it cannot be converted to UTC")
    return moment.astimezone(UTC).isoformat(timespec="microseconds")


def report_text(report: CaptureReport) -> str:
    """Return a report as JSON text; NaN and infinity become null.

    SettingError if a value of another type cannot be written as JSON.
    """
    try:
        return json.dumps(_finite(report.as_json()), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise SettingError(f"the report cannot be written down: {error}") from error


def _finite(value: JsonValue) -> JsonValue:
    """Return a JSON value with null for NaN and infinity."""
    match value:
        case float():
            return value if math.isfinite(value) else None
        case dict():
            return {key: _finite(item) for key, item in value.items()}
        case list():
            return [_finite(item) for item in value]
    return value


def row_of(capture: Capture, lengths_bytes: Mapping[str, int]) -> CaptureRow:
    """Return the row to insert for a capture, with one FileRow per file; `capture.files` holds the SHA-256 by name.

    `lengths_bytes`: length by file name. SettingError for an invalid report or a timestamp without a time zone.
    """
    return CaptureRow(
        id=capture.id,
        eye=capture.eye,
        taken_at=utc_text(capture.taken_at),
        simulated=int(capture.simulated),
        calibration_id=capture.calibration_id,
        report=report_text(capture.report),
        files=[FileRow(name=name, sha256=digest, bytes=lengths_bytes[name]) for name, digest in capture.files.items()],
    )


def json_extract_or_null(column: SQLColumnExpression[str | None], path: str) -> ColumnElement[Any]:
    """Return the SQL expression `json_extract(column, path)`, but NULL for invalid JSON instead of a failed query."""
    return case((func.json_valid(column), func.json_extract(column, path)))
