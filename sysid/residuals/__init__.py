"""Tests and colour of residuals: Ljung–Box, AR(1), HAC covariance, onset delay, feedback."""
