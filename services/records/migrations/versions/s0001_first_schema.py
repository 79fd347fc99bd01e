"""Create the tables of captures, doses, patients, visits, uploads and idempotency keys, with the signing of records.

Triggers make the digest of a record null when one of its values is changed, so that it is signed again before the
commit. There is no downgrade: a rollback of an update leaves the tables as they are (see ../../README.md).
"""

import sqlalchemy as sa
from alembic import op

revision = "s0001"
down_revision = None
branch_labels = None
depends_on = None

KEYS = {"captures": "id", "patients": "patient_id", "visits": "id"}
VALUES = {
    "captures": "eye, taken_at, simulated, calibration_id, report, request",
    "patients": "patient_id, made_at, identity",
    "visits": "patient, day, begun_at, finished_at, outcome, sent, request",
}
PARTS = {  # table of values of a record: table of the record, column with the key of the record
    "files": ("captures", "capture_id"),
    "answers": ("visits", "visit"),
    "changes": ("visits", "visit"),
    "slot_decisions": ("visits", "visit"),
    "uploads": ("visits", "visit"),
}
CORRECTION = "UPDATE OF eye, report ON captures"  # the revision of its visit shows that a capture was corrected
NOT_UPLOADED = "finished_at IS NOT NULL AND (sent IS NULL OR sent <> finished_at)"


def upgrade() -> None:
    """Create all tables, indexes and triggers."""
    _create_captures()
    _create_doses()
    _create_patients()
    _create_visits()
    _create_changes()
    _create_slots()
    _create_uploads()
    _create_requests()
    _create_signing()


def _create_captures() -> None:
    op.create_table(
        "captures",
        sa.Column("id", sa.Text, primary_key=True),
        sa.Column("eye", sa.Text, nullable=False),
        sa.Column("taken_at", sa.Text, nullable=False),
        sa.Column("simulated", sa.Integer, nullable=False),
        sa.Column("calibration_id", sa.Text, nullable=False),
        sa.Column("report", sa.Text, nullable=False),
        _report_column("visit", "text"),
        _report_column("slot", "text"),
        _report_column("verdict", "object"),
        _report_column("laterality", "object"),
        sa.Column("request", sa.Text),
        *_signing_columns(),
        sa.CheckConstraint("eye IN ('OD', 'OS')", name="eye_is_an_eye"),
        sa.CheckConstraint("simulated IN (0, 1)", name="simulated_is_yes_or_no"),
        sa.CheckConstraint("json_valid(report)", name="report_is_json"),
        sqlite_strict=True,
    )
    op.create_index("captures_by_time", "captures", ["taken_at", "id"])
    op.create_table(
        "files",
        sa.Column("capture_id", sa.Text, sa.ForeignKey("captures.id"), primary_key=True),
        sa.Column("name", sa.Text, primary_key=True),
        sa.Column("sha256", sa.Text, nullable=False),
        sa.Column("bytes", sa.Integer, nullable=False),
        sa.CheckConstraint("length(sha256) = 64", name="sha256_is_whole"),
        sa.CheckConstraint("bytes >= 0", name="bytes_is_a_length"),
        sqlite_strict=True,
    )


def _report_column(name: str, kind: str) -> sa.Column[str]:
    """Return the column that SQLite computes from the entry of the report with that JSON type, else null."""
    entry = f"CASE json_type(report, '$.{name}') WHEN '{kind}' THEN json_extract(report, '$.{name}') END"
    return sa.Column(name, sa.Text, sa.Computed(f"CASE WHEN json_valid(report) THEN {entry} END", persisted=False))


def _signing_columns() -> tuple[sa.Column[int], sa.Column[str]]:
    return sa.Column("revision", sa.Integer, nullable=False, server_default="0"), sa.Column("record_sha256", sa.Text)


def _create_doses() -> None:
    op.create_table(
        "doses",
        sa.Column("eye", sa.Text, primary_key=True),
        sa.Column("interval", sa.Integer, primary_key=True),
        sa.Column("dose_j_per_cm2", sa.REAL, nullable=False),
        sa.CheckConstraint("eye IN ('OD', 'OS')", name="dose_is_of_an_eye"),
        sa.CheckConstraint("dose_j_per_cm2 >= 0", name="dose_is_not_negative"),
        sqlite_strict=True,
    )
    op.create_table(
        "observed_time",
        sa.Column("id", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("boot", sa.Text, nullable=False),
        sa.Column("now_s", sa.REAL, nullable=False),
        sa.Column("observed_s", sa.REAL, nullable=False),
        sa.CheckConstraint("id = 1", name="time_is_one_row"),
        sqlite_strict=True,
    )


def _create_patients() -> None:
    op.create_table(
        "patients",
        sa.Column("patient_id", sa.Text, primary_key=True),
        sa.Column("made_at", sa.Text, nullable=False),
        sa.Column("identity", sa.Text, nullable=False),
        *_signing_columns(),
        sqlite_strict=True,
    )
    op.create_table(
        "counters",
        sa.Column("prefix", sa.Text, primary_key=True),
        sa.Column("last", sa.Integer, nullable=False),
        sa.CheckConstraint("last >= 0", name="counter_is_not_negative"),
        sqlite_strict=True,
    )


def _create_visits() -> None:
    op.create_table(
        "visits",
        sa.Column("id", sa.Text, primary_key=True),
        sa.Column("patient", sa.Text, sa.ForeignKey("patients.patient_id"), nullable=False),
        sa.Column("day", sa.Text, nullable=False),
        sa.Column("begun_at", sa.Text, nullable=False),
        sa.Column("finished_at", sa.Text),
        sa.Column("outcome", sa.Text),
        sa.Column("sent", sa.Text),
        sa.Column("request", sa.Text),
        *_signing_columns(),
        sa.CheckConstraint("(finished_at IS NULL) = (outcome IS NULL)", name="finished_has_an_outcome"),
        sa.CheckConstraint("outcome IS NULL OR json_valid(outcome)", name="outcome_is_json"),
        sqlite_strict=True,
    )
    op.create_index("visits_by_time", "visits", ["begun_at", "id"])
    op.create_index("visits_by_day", "visits", ["day"])
    op.create_index("visits_to_upload", "visits", ["finished_at"], sqlite_where=sa.text(NOT_UPLOADED))
    op.create_table(
        "answers",
        sa.Column("visit", sa.Text, sa.ForeignKey("visits.id"), primary_key=True),
        sa.Column("name", sa.Text, primary_key=True),
        sa.Column("value", sa.Text, nullable=False),
        sa.Column("set_at", sa.Text, nullable=False),
        sa.CheckConstraint("json_valid(value)", name="answer_is_json"),
        sa.CheckConstraint("length(value) <= 2000", name="answer_is_short"),
        sqlite_strict=True,
    )


def _create_changes() -> None:
    op.create_table(
        "changes",
        sa.Column("visit", sa.Text, sa.ForeignKey("visits.id"), primary_key=True),
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("at", sa.Text, nullable=False),
        sa.Column("user", sa.Text, nullable=False),
        sa.Column("field", sa.Text, nullable=False),
        sa.Column("was", sa.Text, nullable=False),
        sa.Column("value", sa.Text, nullable=False),
        sa.Column("why", sa.Text),
        sa.CheckConstraint("json_valid(was) AND json_valid(value)", name="change_is_json"),
        sqlite_strict=True,
    )


def _create_slots() -> None:
    op.create_table(
        "capture_slots",
        sa.Column("capture", sa.Text, sa.ForeignKey("captures.id"), primary_key=True),
        sa.Column("visit", sa.Text, sa.ForeignKey("visits.id"), nullable=False),
        sa.Column("slot", sa.Text, nullable=False),
        sqlite_strict=True,
    )
    op.create_index("capture_slots_by_visit", "capture_slots", ["visit"])
    op.create_table(
        "slot_decisions",
        sa.Column("visit", sa.Text, sa.ForeignKey("visits.id"), primary_key=True),
        sa.Column("slot", sa.Text, primary_key=True),
        sa.Column("capture", sa.Text, sa.ForeignKey("captures.id")),
        sa.Column("reason", sa.Text),
        sa.CheckConstraint("capture IS NULL OR reason IS NULL", name="capture_or_reason"),
        sqlite_strict=True,
    )


def _create_uploads() -> None:
    op.create_table(
        "uploads",
        sa.Column("visit", sa.Text, sa.ForeignKey("visits.id"), primary_key=True),
        sa.Column("finished_at", sa.Text, primary_key=True),
        sa.Column("tries", sa.Integer, nullable=False),
        sa.Column("failing_since", sa.Text),
        sa.Column("error", sa.Text),
        sa.Column("message", sa.Text),
        sa.Column("sent_at", sa.Text),
        sa.Column("sha256", sa.Text),
        sa.Column("confirmed", sa.Text),
        sa.CheckConstraint("tries >= 0", name="tries_are_not_negative"),
        sa.CheckConstraint("(sent_at IS NULL) = (sha256 IS NULL)", name="sent_has_a_digest"),
        sa.CheckConstraint("(sent_at IS NULL) = (confirmed IS NULL)", name="sent_has_a_confirmation"),
        sqlite_strict=True,
    )


def _create_requests() -> None:
    op.create_table(
        "idempotency_keys",
        sa.Column("key", sa.Text, primary_key=True),
        sa.Column("request", sa.Text, nullable=False),
        sa.Column("answer", sa.Text, nullable=False),
        sa.Column("done_at", sa.Text, nullable=False),
        sa.CheckConstraint("length(key) = 16", name="key_is_whole"),
        sqlite_strict=True,
    )
    op.create_index("idempotency_keys_by_time", "idempotency_keys", ["done_at"])


def _create_signing() -> None:
    """Create the indexes of unsigned records, and the triggers that make the digest of a changed record null."""
    for table, key in KEYS.items():
        op.create_index(f"{table}_to_sign", table, [key], sqlite_where=sa.text("record_sha256 IS NULL"))
        op.execute(_trigger(f"{table}_changed", f"UPDATE OF {VALUES[table]} ON {table}", table, f"NEW.{key}"))
    op.execute(_trigger("captures_of_visit_changed", CORRECTION, "visits", "NEW.visit"))
    for part, (table, column) in PARTS.items():
        for event, row in (("INSERT", "NEW"), ("UPDATE", "NEW"), ("DELETE", "OLD")):
            sent_only = f" WHEN {row}.sent_at IS NOT NULL" if part == "uploads" else ""
            name = f"{part}_{event.lower()}"
            op.execute(_trigger(name, f"{event} ON {part}{sent_only}", table, f"{row}.{column}"))


def _trigger(name: str, change: str, table: str, key: str) -> str:
    """Return the SQL of a trigger that only makes the digest of the changed record null."""
    body = f"UPDATE {table} SET record_sha256 = NULL WHERE {KEYS[table]} = {key}"
    return f"CREATE TRIGGER {name} AFTER {change} BEGIN {body}; END"
