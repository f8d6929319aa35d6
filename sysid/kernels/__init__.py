"""From a checked model to machine code that simulates a population."""
