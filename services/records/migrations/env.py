"""What Alembic runs for a migration: its steps, in the transaction that `schema.migrate` holds."""

from alembic import context

from services.records.schema import Shelf

context.configure(connection=context.config.attributes["connection"], target_metadata=Shelf.metadata)
context.run_migrations()
