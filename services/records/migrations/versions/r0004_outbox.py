"""Add the upload queue: column `visits.sent` and table `sendings`; finished visits are in the queue from then on."""

import sqlalchemy as sa
from alembic import op

revision = "r0004"
down_revision = "r0003"
branch_labels = None
depends_on = None

UNSENT = "finished_at IS NOT NULL AND (sent IS NULL OR sent <> finished_at)"


def upgrade() -> None:
    """Add the column with its index, and create the table, empty."""
    op.add_column("visits", sa.Column("sent", sa.Text))
    op.create_index("visits_to_send", "visits", ["finished_at"], sqlite_where=sa.text(UNSENT))
    op.create_table(
        "sendings",
        sa.Column("visit", sa.Text, sa.ForeignKey("visits.id"), primary_key=True),
        sa.Column("finished_at", sa.Text, primary_key=True),
        sa.Column("tries", sa.Integer, nullable=False),
        sa.Column("failing_since", sa.Text),
        sa.Column("error", sa.Text),
        sa.Column("said", sa.Text),
        sa.Column("sent_at", sa.Text),
        sa.Column("sha256", sa.Text),
        sa.Column("confirmed", sa.Text),
        sa.CheckConstraint("tries >= 0", name="tries_are_counted"),
        sa.CheckConstraint("(sent_at IS NULL) = (sha256 IS NULL)", name="what_was_sent_is_known"),
        sa.CheckConstraint("(sent_at IS NULL) = (confirmed IS NULL)", name="what_was_sent_was_confirmed"),
        sqlite_strict=True,
    )
