"""Records on a grid → `Problem`; simulate, evaluate a population, metrics, unit scaling."""
