"""FastAPI: one thin file per resource."""
