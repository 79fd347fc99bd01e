"""Create the tables of patients, visits, answers, slots and idempotency keys; present tables stay unchanged."""

import sqlalchemy as sa
from alembic import op

revision = "r0003"
down_revision = "r0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Create the tables, empty."""
    _make_persons()
    _make_visits()
    _make_slots()
    op.create_table(
        "counters",
        sa.Column("prefix", sa.Text, primary_key=True),
        sa.Column("last", sa.Integer, nullable=False),
        sa.CheckConstraint("last >= 0", name="counters_count"),
        sqlite_strict=True,
    )
    op.create_table(
        "keys",
        sa.Column("key", sa.Text, primary_key=True),
        sa.Column("request", sa.Text, nullable=False),
        sa.Column("answer", sa.Text, nullable=False),
        sa.Column("done_at", sa.Text, nullable=False),
        sa.CheckConstraint("length(key) = 16", name="key_is_whole"),
        sqlite_strict=True,
    )
    op.create_index("keys_by_time", "keys", ["done_at"])


def _make_persons() -> None:
    op.create_table(
        "persons",
        sa.Column("number", sa.Text, primary_key=True),
        sa.Column("made_at", sa.Text, nullable=False),
        sa.CheckConstraint("length(number) BETWEEN 1 AND 20", name="number_is_short"),
        sqlite_strict=True,
    )
    op.create_table(
        "identifiers",
        sa.Column("person", sa.Text, sa.ForeignKey("persons.number"), primary_key=True),
        sa.Column("name", sa.Text, primary_key=True),
        sa.Column("value", sa.Text, nullable=False),
        sa.CheckConstraint("json_valid(value)", name="identifier_is_json"),
        sa.CheckConstraint("length(value) <= 2000", name="identifier_is_short"),
        sqlite_strict=True,
    )


def _make_visits() -> None:
    op.create_table(
        "visits",
        sa.Column("id", sa.Text, primary_key=True),
        sa.Column("person", sa.Text, sa.ForeignKey("persons.number"), nullable=False),
        sa.Column("day", sa.Text, nullable=False),
        sa.Column("begun_at", sa.Text, nullable=False),
        sa.Column("finished_at", sa.Text),
        sa.Column("outcome", sa.Text),
        sa.CheckConstraint("(finished_at IS NULL) = (outcome IS NULL)", name="what_is_finished_has_an_outcome"),
        sa.CheckConstraint("outcome IS NULL OR json_valid(outcome)", name="outcome_is_json"),
        sqlite_strict=True,
    )
    op.create_index("visits_by_time", "visits", ["begun_at", "id"])
    op.create_index("visits_by_day", "visits", ["day"])
    op.create_table(
        "fields",
        sa.Column("visit", sa.Text, sa.ForeignKey("visits.id"), primary_key=True),
        sa.Column("name", sa.Text, primary_key=True),
        sa.Column("value", sa.Text, nullable=False),
        sa.Column("set_at", sa.Text, nullable=False),
        sa.CheckConstraint("json_valid(value)", name="field_is_json"),
        sa.CheckConstraint("length(value) <= 2000", name="field_is_short"),
        sqlite_strict=True,
    )


def _make_slots() -> None:
    op.create_table(
        "shots",
        sa.Column("capture", sa.Text, sa.ForeignKey("captures.id"), primary_key=True),
        sa.Column("visit", sa.Text, sa.ForeignKey("visits.id"), nullable=False),
        sa.Column("slot", sa.Text, nullable=False),
        sqlite_strict=True,
    )
    op.create_index("shots_by_visit", "shots", ["visit"])
    op.create_table(
        "slots",
        sa.Column("visit", sa.Text, sa.ForeignKey("visits.id"), primary_key=True),
        sa.Column("slot", sa.Text, primary_key=True),
        sa.Column("capture", sa.Text, sa.ForeignKey("captures.id")),
        sa.Column("reason", sa.Text),
        sa.CheckConstraint("capture IS NULL OR reason IS NULL", name="taken_or_could_not"),
        sqlite_strict=True,
    )
