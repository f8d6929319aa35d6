"""Models, records, twins and exported programs for tests of the numerical core."""
