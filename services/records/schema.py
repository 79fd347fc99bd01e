"""The index of the shelf: which captures were kept, and what each of their files must be."""

import json
import math
from collections.abc import Callable, Mapping
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import (
    REAL,
    URL,
    CheckConstraint,
    Connection,
    Engine,
    ForeignKey,
    Index,
    Integer,
    Text,
    create_engine,
    event,
    literal_column,
    text,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column, relationship
from sqlalchemy.pool import ConnectionPoolEntry

from device.errors import SettingError
from device.values import Capture

MIGRATIONS = Path(__file__).parent / "migrations"

# WAL with FULL is the fastest pair that lost no acknowledged row in power-cut trials; NORMAL lost the last ones.
BUSY_MS, CHECKPOINT_BUSY_MS = 5000, 200  # whoever writes waits; a checkpoint gives up and is tried again later
PRAGMAS = (
    f"PRAGMA busy_timeout = {BUSY_MS}",
    "PRAGMA journal_mode = WAL",
    "PRAGMA synchronous = FULL",
    "PRAGMA foreign_keys = ON",
)


class Shelf(DeclarativeBase):
    """All tables."""


class CaptureRow(Shelf):
    """One kept press; `taken_at` is UTC with six decimals, so that text sorts as time does."""

    __tablename__ = "captures"

    id: Mapped[str] = mapped_column(Text, primary_key=True)
    eye: Mapped[str] = mapped_column(Text)
    taken_at: Mapped[str] = mapped_column(Text)
    simulated: Mapped[int]
    calibration_id: Mapped[str] = mapped_column(Text)
    report: Mapped[str] = mapped_column(Text)
    files: Mapped[list["FileRow"]] = relationship(order_by="FileRow.name")

    __table_args__ = (
        CheckConstraint("eye IN ('OD', 'OS')", name="eye_is_an_eye"),
        CheckConstraint("simulated IN (0, 1)", name="simulated_is_yes_or_no"),
        CheckConstraint("json_valid(report)", name="report_is_json"),
        Index("captures_by_time", "taken_at", "id"),
        {"sqlite_strict": True},
    )


KEPT = literal_column("captures.rowid", Integer).label("kept")  # grows with each one that is kept, as no date does


class FileRow(Shelf):
    """One kept file: its SHA-256 in hexadecimal digits and its length in bytes."""

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


class LightRow(Shelf):
    """What an eye got in one slot of observed time (device/ledger.py), reservations that were not settled included."""

    __tablename__ = "light_doses"

    eye: Mapped[str] = mapped_column(Text, primary_key=True)
    slot: Mapped[int] = mapped_column(primary_key=True)
    dose_j_per_cm2: Mapped[float] = mapped_column(REAL)

    __table_args__ = (
        CheckConstraint("eye IN ('OD', 'OS')", name="light_fell_on_an_eye"),
        CheckConstraint("dose_j_per_cm2 >= 0", name="light_is_not_given_back"),
        {"sqlite_strict": True},
    )


class SeenRow(Shelf):
    """One row: how much time was seen until a moment of a boot, by which light ages."""

    __tablename__ = "light_time"

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    boot: Mapped[str] = mapped_column(Text)
    now_s: Mapped[float] = mapped_column(REAL)
    observed_s: Mapped[float] = mapped_column(REAL)

    __table_args__ = (CheckConstraint("id = 1", name="time_is_one"), {"sqlite_strict": True})


class PersonRow(Shelf):
    """Somebody who was here, known by a number alone."""

    __tablename__ = "persons"

    number: Mapped[str] = mapped_column(Text, primary_key=True)
    made_at: Mapped[str] = mapped_column(Text)

    __table_args__ = (
        CheckConstraint("length(number) BETWEEN 1 AND 20", name="number_is_short"),
        {"sqlite_strict": True},
    )


class IdentifierRow(Shelf):
    """What tells who a number is, apart from everything else: a name, a phone, a village; `value` is JSON."""

    __tablename__ = "identifiers"

    person: Mapped[str] = mapped_column(Text, ForeignKey("persons.number"), primary_key=True)
    name: Mapped[str] = mapped_column(Text, primary_key=True)
    value: Mapped[str] = mapped_column(Text)

    __table_args__ = (
        CheckConstraint("json_valid(value)", name="identifier_is_json"),
        CheckConstraint("length(value) <= 2000", name="identifier_is_short"),
        {"sqlite_strict": True},
    )


UNSENT = "finished_at IS NOT NULL AND (sent IS NULL OR sent <> finished_at)"


class VisitRow(Shelf):
    """One visit; `day` is the calendar's where the instrument stands, moments are UTC; `outcome` is JSON."""

    __tablename__ = "visits"

    id: Mapped[str] = mapped_column(Text, primary_key=True)
    person: Mapped[str] = mapped_column(Text, ForeignKey("persons.number"))
    day: Mapped[str] = mapped_column(Text)
    begun_at: Mapped[str] = mapped_column(Text)
    finished_at: Mapped[str | None] = mapped_column(Text)
    outcome: Mapped[str | None] = mapped_column(Text)
    sent: Mapped[str | None] = mapped_column(Text)  # the `finished_at` of what was sent last

    __table_args__ = (
        CheckConstraint("(finished_at IS NULL) = (outcome IS NULL)", name="what_is_finished_has_an_outcome"),
        CheckConstraint("outcome IS NULL OR json_valid(outcome)", name="outcome_is_json"),
        Index("visits_by_time", "begun_at", "id"),
        Index("visits_by_day", "day"),
        Index("visits_to_send", "finished_at", sqlite_where=text(UNSENT)),  # as small as what waits
        {"sqlite_strict": True},
    )


class FieldRow(Shelf):
    """One answer of a visit, written as soon as it was given; `value` is JSON."""

    __tablename__ = "fields"

    visit: Mapped[str] = mapped_column(Text, ForeignKey("visits.id"), primary_key=True)
    name: Mapped[str] = mapped_column(Text, primary_key=True)
    value: Mapped[str] = mapped_column(Text)
    set_at: Mapped[str] = mapped_column(Text)

    __table_args__ = (
        CheckConstraint("json_valid(value)", name="field_is_json"),
        CheckConstraint("length(value) <= 2000", name="field_is_short"),
        {"sqlite_strict": True},
    )


class ShotRow(Shelf):
    """To which slot of which visit a capture belongs."""

    __tablename__ = "shots"

    capture: Mapped[str] = mapped_column(Text, ForeignKey("captures.id"), primary_key=True)
    visit: Mapped[str] = mapped_column(Text, ForeignKey("visits.id"))
    slot: Mapped[str] = mapped_column(Text)

    __table_args__ = (Index("shots_by_visit", "visit"), {"sqlite_strict": True})


class SlotRow(Shelf):
    """What somebody decided about a slot: this capture, or could not and why, or neither: it is empty again."""

    __tablename__ = "slots"

    visit: Mapped[str] = mapped_column(Text, ForeignKey("visits.id"), primary_key=True)
    slot: Mapped[str] = mapped_column(Text, primary_key=True)
    capture: Mapped[str | None] = mapped_column(Text, ForeignKey("captures.id"))
    reason: Mapped[str | None] = mapped_column(Text)

    __table_args__ = (
        CheckConstraint("capture IS NULL OR reason IS NULL", name="taken_or_could_not"),
        {"sqlite_strict": True},
    )


class SendingRow(Shelf):
    """What became of sending a visit as it was finished at that moment; before the first try there is none.

    `failing_since`, `error` and `said`: since when and why not. `confirmed` is by what the receiver proved that it has
    it: the SHA-256 of the parcel, or its length alone.
    """

    __tablename__ = "sendings"

    visit: Mapped[str] = mapped_column(Text, ForeignKey("visits.id"), primary_key=True)
    finished_at: Mapped[str] = mapped_column(Text, primary_key=True)
    tries: Mapped[int]
    failing_since: Mapped[str | None] = mapped_column(Text)
    error: Mapped[str | None] = mapped_column(Text)
    said: Mapped[str | None] = mapped_column(Text)
    sent_at: Mapped[str | None] = mapped_column(Text)
    sha256: Mapped[str | None] = mapped_column(Text)
    confirmed: Mapped[str | None] = mapped_column(Text)

    __table_args__ = (
        CheckConstraint("tries >= 0", name="tries_are_counted"),
        CheckConstraint("(sent_at IS NULL) = (sha256 IS NULL)", name="what_was_sent_is_known"),
        CheckConstraint("(sent_at IS NULL) = (confirmed IS NULL)", name="what_was_sent_was_confirmed"),
        {"sqlite_strict": True},
    )


class CounterRow(Shelf):
    """The last automatic number that was given under a prefix."""

    __tablename__ = "counters"

    prefix: Mapped[str] = mapped_column(Text, primary_key=True)
    last: Mapped[int]

    __table_args__ = (CheckConstraint("last >= 0", name="counters_count"), {"sqlite_strict": True})


class KeyRow(Shelf):
    """A request that was done, and its answer, so that its repetition does nothing."""

    __tablename__ = "keys"

    key: Mapped[str] = mapped_column(Text, primary_key=True)
    request: Mapped[str] = mapped_column(Text)
    answer: Mapped[str] = mapped_column(Text)
    done_at: Mapped[str] = mapped_column(Text)

    __table_args__ = (
        CheckConstraint("length(key) = 16", name="key_is_whole"),
        Index("keys_by_time", "done_at"),
        {"sqlite_strict": True},
    )


def open_engine(path: Path) -> Engine:
    """Connections to one SQLite file, safe to use from any thread; a connection that asks for `writing` waits its turn.

    The driver's own transaction handling is off: it would commit before schema changes and so tear a migration in two.
    """
    engine = create_engine(URL.create("sqlite", database=str(path)))
    event.listen(engine, "connect", _prepare)
    event.listen(engine, "begin", _begin)
    return engine


def _prepare(connection: Any, _entry: ConnectionPoolEntry) -> None:
    """Set up one new connection of the driver."""
    connection.isolation_level = None
    connection.text_factory = _decoded
    for pragma in PRAGMAS:
        connection.execute(pragma).close()


def _decoded(content: bytes) -> str:
    """Text as it is, also where it is no UTF-8: `reading` refuses that for its row, the driver would for all rows."""
    return content.decode(errors="surrogateescape")


def _begin(connection: Connection) -> None:
    """Begin for reading, or take the one place for writing at once: taking it halfway through cannot be waited for."""
    writing = connection.get_execution_options().get("writing", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")


def for_writing(engine: Engine) -> Engine:
    """The same connections, for a transaction that writes."""
    return engine.execution_options(writing=True)


def checkpoint(engine: Engine) -> bool:
    """Write the rows of the write-ahead log into the main file, on the disk when this returns, and empty the log.

    False if another connection reads or writes longer than CHECKPOINT_BUSY_MS: then no row has moved, or some have.
    """
    with closing(engine.raw_connection()) as pooled:  # a transaction, which `connect` would begin, may not checkpoint
        connection: Any = pooled.driver_connection
        connection.execute(f"PRAGMA busy_timeout = {CHECKPOINT_BUSY_MS}").close()
        try:
            busy = connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()[0]
        finally:
            connection.execute(f"PRAGMA busy_timeout = {BUSY_MS}").close()
    return not busy


def migrate(engine: Engine, before: Callable[[str], None]) -> None:
    """Bring the tables to this version in one transaction, and leave tables of a newer version as they are.

    A newer version is met after an update was rolled back. It only added (README, "add a column"), so we can go on.
    `before` hears the version of tables that are about to change; what it raises leaves them as they are.
    """
    config = migration_config()
    scripts = ScriptDirectory.from_config(config)
    known = {script.revision for script in scripts.walk_revisions()}
    with engine.connect() as connection:
        present = set(MigrationContext.configure(connection).get_current_heads())
    if not present <= known or present == set(scripts.get_heads()):
        return
    for version in present:
        before(version)
    with for_writing(engine).begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "head")


def migration_config() -> Config:
    """Alembic's settings; the migrations travel inside the package."""
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    return config


def utc_text(moment: datetime) -> str:
    """A moment as UTC text that sorts as time does; refuses a time without a zone (SettingError)."""
    if moment.tzinfo is None:
        raise SettingError(f"the moment {moment} has no time zone, so nobody can say when it was")
    return moment.astimezone(UTC).isoformat(timespec="microseconds")


def report_text(report: Mapping[str, Any]) -> str:
    """A report as JSON; a number that is none (NaN, infinite) becomes null, for no picture is lost over a footnote."""
    try:
        return json.dumps(_plain(report), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise SettingError(f"the report cannot be written down: {error}") from error


def _plain(value: Any) -> Any:
    """The same value in what JSON knows."""
    match value:
        case np.generic() | np.ndarray():
            return _plain(value.tolist())
        case float():
            return value if math.isfinite(value) else None
        case Mapping():
            return {str(key): _plain(item) for key, item in value.items()}
        case list() | tuple():
            return [_plain(item) for item in value]
    return value


def row_of(capture: Capture, lengths_bytes: Mapping[str, int]) -> CaptureRow:
    """The rows to insert for a capture whose `files` holds the digests."""
    return CaptureRow(
        id=capture.id,
        eye=capture.eye,
        taken_at=utc_text(capture.taken_at),
        simulated=int(capture.simulated),
        calibration_id=capture.calibration_id,
        report=report_text(capture.report),
        files=[FileRow(name=name, sha256=digest, bytes=lengths_bytes[name]) for name, digest in capture.files.items()],
    )
