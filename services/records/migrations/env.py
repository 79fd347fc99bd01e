"""Alembic environment: run the migration in the transaction that `schema.migrate` opened."""

from alembic import context

from services.records.schema import Base

context.configure(connection=context.config.attributes["connection"], target_metadata=Base.metadata)
context.run_migrations()
