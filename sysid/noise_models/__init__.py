"""Noise models: generalised least squares (AR(1)), and the choice that ``auto`` makes."""
