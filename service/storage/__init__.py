"""SQL and the object store."""
