"""The genetic algorithm of the paper and its improvement, one island at a time."""
