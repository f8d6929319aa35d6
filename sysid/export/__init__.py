"""An identified model as JSON, Python, C, python-control (last two optional)."""
