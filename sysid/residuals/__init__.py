"""Residual tests and colour: Ljung–Box, AR(1), HAC covariance, onset delay, feedback."""
