"""Identification of nonlinear systems with unknown time lags: the numerical core."""
