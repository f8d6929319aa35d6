"""Built-in systems, as documents in the model language."""
