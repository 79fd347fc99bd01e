"""Create the tables of the dose ledger: dose of each eye, and the observed time by which doses expire."""

import sqlalchemy as sa
from alembic import op

revision = "r0002"
down_revision = "r0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Create both tables, empty."""
    op.create_table(
        "light_doses",
        sa.Column("eye", sa.Text, primary_key=True),
        sa.Column("slot", sa.Integer, primary_key=True),
        sa.Column("dose_j_per_cm2", sa.REAL, nullable=False),
        sa.CheckConstraint("eye IN ('OD', 'OS')", name="light_fell_on_an_eye"),
        sa.CheckConstraint("dose_j_per_cm2 >= 0", name="light_is_not_given_back"),
        sqlite_strict=True,
    )
    op.create_table(
        "light_time",
        sa.Column("id", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("boot", sa.Text, nullable=False),
        sa.Column("now_s", sa.REAL, nullable=False),
        sa.Column("observed_s", sa.REAL, nullable=False),
        sa.CheckConstraint("id = 1", name="time_is_one"),
        sqlite_strict=True,
    )
