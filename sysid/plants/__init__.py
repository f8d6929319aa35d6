"""Reference plants: systems simulated finer than any model of them, to identify and compare."""
