"""FastAPI routes: one thin file per resource."""
