"""Inspection: what happened to a record before anybody fitted it; a file for each kind."""
