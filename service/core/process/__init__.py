"""What a process of the service has: logs, metrics, limits, identity, temporary files."""
