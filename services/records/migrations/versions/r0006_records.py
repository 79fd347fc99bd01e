"""Add revision and digest of the record of each patient, visit and capture, the patient's id, and the request's key.

Triggers make the digest null when a value of the record is changed. An earlier release, which does not know the
digests, so leaves records that are to be signed again, and not records that look damaged.
"""

import sqlalchemy as sa
from alembic import op

revision = "r0006"
down_revision = "r0005"
branch_labels = None
depends_on = None

KEYS = {"captures": "id", "persons": "number", "visits": "id"}
VALUES = {
    "captures": "eye, taken_at, simulated, calibration_id, report, request",
    "persons": "number, made_at, patient_id",
    "visits": "person, day, begun_at, finished_at, outcome, sent, request",
}
PARTS = {  # table of values of a record: table of the record, column with the key of the record
    "files": ("captures", "capture_id"),
    "identifiers": ("persons", "person"),
    "fields": ("visits", "visit"),
    "slots": ("visits", "visit"),
    "sendings": ("visits", "visit"),
}
CORRECTION = "UPDATE OF eye, report ON captures"  # the revision of its visit shows that a capture was corrected


def upgrade() -> None:
    """Add the columns, the partial indexes of unsigned records, and the triggers."""
    for table in ("captures", "visits"):
        op.add_column(table, sa.Column("request", sa.Text))
    op.add_column("persons", sa.Column("patient_id", sa.Text))
    for table, key in KEYS.items():
        op.add_column(table, sa.Column("revision", sa.Integer, nullable=False, server_default="0"))
        op.add_column(table, sa.Column("record_sha256", sa.Text))
        op.create_index(f"{table}_to_sign", table, [key], sqlite_where=sa.text("record_sha256 IS NULL"))
        op.execute(_trigger(f"{table}_changed", f"UPDATE OF {VALUES[table]} ON {table}", table, f"NEW.{key}"))
    op.execute(_trigger("captures_of_visit_changed", CORRECTION, "visits", "NEW.visit"))
    for part, (table, column) in PARTS.items():
        for event, row in (("INSERT", "NEW"), ("UPDATE", "NEW"), ("DELETE", "OLD")):
            sent_only = f" WHEN {row}.sent_at IS NOT NULL" if part == "sendings" else ""
            name = f"{part}_{event.lower()}"
            op.execute(_trigger(name, f"{event} ON {part}{sent_only}", table, f"{row}.{column}"))


def _trigger(name: str, change: str, table: str, key: str) -> str:
    """Return the SQL of a trigger that only makes the digest of the changed record null."""
    body = f"UPDATE {table} SET record_sha256 = NULL WHERE {KEYS[table]} = {key}"
    return f"CREATE TRIGGER {name} AFTER {change} BEGIN {body}; END"
