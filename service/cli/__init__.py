"""The command line `lagid`."""
