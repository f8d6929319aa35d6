"""MCAP files: written, read within limits, and their layout."""
