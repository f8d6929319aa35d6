"""The dispatcher process: claim, prepare, feed workers, record."""
