"""How stored data are kept: retention, purge, backup and restore."""
