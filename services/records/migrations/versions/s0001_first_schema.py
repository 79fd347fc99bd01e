"""Schema of the first release; a new database gets the present tables at once, see `schema.migrate`.

There is no downgrade: a rollback of an update leaves the tables as they are (see ../../README.md).
"""

revision = "s0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Change nothing: there are no tables of an earlier release."""
