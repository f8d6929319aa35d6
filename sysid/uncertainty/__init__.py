"""Standard errors, correlations, Cramér–Rao, profile likelihood."""
