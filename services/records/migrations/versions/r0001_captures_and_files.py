"""Create the tables of captures and of their files.

There is no downgrade: a rollback of an update leaves the tables as they are (see ../../README.md).
"""

import sqlalchemy as sa
from alembic import op

revision = "r0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Create both tables."""
    _make_captures()
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


def _make_captures() -> None:
    op.create_table(
        "captures",
        sa.Column("id", sa.Text, primary_key=True),
        sa.Column("eye", sa.Text, nullable=False),
        sa.Column("taken_at", sa.Text, nullable=False),
        sa.Column("simulated", sa.Integer, nullable=False),
        sa.Column("calibration_id", sa.Text, nullable=False),
        sa.Column("report", sa.Text, nullable=False),
        sa.CheckConstraint("eye IN ('OD', 'OS')", name="eye_is_an_eye"),
        sa.CheckConstraint("simulated IN (0, 1)", name="simulated_is_yes_or_no"),
        sa.CheckConstraint("json_valid(report)", name="report_is_json"),
        sqlite_strict=True,
    )
    op.create_index("captures_by_time", "captures", ["taken_at", "id"])
