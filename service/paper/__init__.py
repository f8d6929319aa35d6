"""The paper's tables and figures, made anew by jobs of the service and shown beside its own."""
