"""Who may do what: keys, projects, limits, and the audit log."""
