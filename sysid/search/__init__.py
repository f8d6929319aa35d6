"""One island: GA, sequence search, Levenberg–Marquardt, basin hopping, refinement; one LM only."""
