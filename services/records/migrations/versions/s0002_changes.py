"""Add the history of each visit: a table of changes, whose rows are a part of the record of the visit.

As in the first schema, triggers make the digest of a changed record null. A visit without changes keeps its record.
"""

import sqlalchemy as sa
from alembic import op

revision = "s0002"
down_revision = "s0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Create the table, empty, and its triggers."""
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
    for event, row in (("INSERT", "NEW"), ("UPDATE", "NEW"), ("DELETE", "OLD")):
        body = f"UPDATE visits SET record_sha256 = NULL WHERE id = {row}.visit"
        op.execute(f"CREATE TRIGGER changes_{event.lower()} AFTER {event} ON changes BEGIN {body}; END")
