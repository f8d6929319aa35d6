"""Who may do what: API keys, sessions of browsers, and the scopes of requests."""
