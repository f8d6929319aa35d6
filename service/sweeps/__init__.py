"""The recipes (noise sweep, re-identification) and their summaries."""
