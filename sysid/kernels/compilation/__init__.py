"""From a model to loaded machine code, compiled in a child with limits."""
