"""Programs that use lagid as its users do, by its public names only; not installed."""
