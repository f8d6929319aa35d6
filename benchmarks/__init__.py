"""Programs that measure lagid and print a table."""
