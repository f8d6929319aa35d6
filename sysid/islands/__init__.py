"""Archipelago: topology, migration, packed compiled evolution, stopping."""
