"""Identifiability of parameters: symmetries, null directions, active bounds."""
