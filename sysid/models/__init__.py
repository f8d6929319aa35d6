"""Models: documents, parameters, equations, polynomials, ties, units, and the catalogue."""
