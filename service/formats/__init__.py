"""MCAP and CSV, read in a sandboxed child; decimation."""
