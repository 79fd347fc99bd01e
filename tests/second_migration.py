"""A made-up second migration of the tables, for tests of migrations, of snapshots and of a rolled-back release."""

import shutil
from pathlib import Path

from device.clock import Clock
from services.records import schema
from services.records.snapshots import Snapshots

FIRST, SECOND = "s0001", "s0002"
MADE_UP = '''"""Add a note to each capture, and a table of notes."""

import sqlalchemy as sa
from alembic import op

revision = "s0002"
down_revision = "s0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column, and create the table, empty."""
    op.add_column("captures", sa.Column("note", sa.Text, nullable=False, server_default=""))
    op.add_column("doses", sa.Column("lamp", sa.Text))
    op.create_table("notes", sa.Column("id", sa.Text, primary_key=True), sqlite_strict=True)
'''


def with_second_migration(folder: Path) -> Path:
    """Return a new folder below `folder` with the migrations of this release and the made-up one."""
    migrations = Path(shutil.copytree(schema.MIGRATIONS, folder / "migrations"))
    (migrations / "versions" / "s0002_made_up.py").write_text(MADE_UP, encoding="utf-8")
    return migrations


def migrate(store: Path, migrations: Path, clock: Clock, free_bytes: int = 10**12) -> None:
    """Migrate the tables of a store as the release with these migrations does at its start."""
    database = store / schema.DATABASE
    engine = schema.open_engine(database)
    try:
        schema.migrate(engine, Snapshots(database, clock, lambda _: free_bytes).create, migrations)
    finally:
        engine.dispose()
