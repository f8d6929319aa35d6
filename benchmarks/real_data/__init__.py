"""Programs on measured records, through the service."""
