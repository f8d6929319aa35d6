"""Alembic's migrations of the storage; the service runs them at its start."""
