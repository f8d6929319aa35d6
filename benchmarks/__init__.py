"""Programs that measure lagid and print tables."""
