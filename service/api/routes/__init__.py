"""Routes: one thin file for each resource."""
