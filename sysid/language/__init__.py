"""Model language: parser, checker, scopes, delays, intervals, printer."""
