"""Add visit, slot, verdict and laterality of a capture as columns that SQLite computes from the stored report.

Generated columns need no copying of rows, cannot disagree with the report, and hold the values of rows that an earlier
release writes after a rollback. A report that is no valid JSON, or an entry of another type, gives null.
"""

import sqlalchemy as sa
from alembic import op

revision = "r0005"
down_revision = "r0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the columns."""
    for name, kind in (("visit", "text"), ("slot", "text"), ("verdict", "object"), ("laterality", "object")):
        op.add_column("captures", sa.Column(name, sa.Text, sa.Computed(_entry(name, kind), persisted=False)))


def _entry(name: str, kind: str) -> str:
    """Return the SQL expression of an entry of the report with that JSON type, else null."""
    entry = f"CASE json_type(report, '$.{name}') WHEN '{kind}' THEN json_extract(report, '$.{name}') END"
    return f"CASE WHEN json_valid(report) THEN {entry} END"
