"""An identified model as text for other programs: JSON, Python, C99, python-control."""
