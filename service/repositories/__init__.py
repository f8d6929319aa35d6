"""SQL reads and writes per entity."""
