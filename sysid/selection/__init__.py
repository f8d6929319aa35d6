"""Polynomial term selection (FROLS) and the search of its unknown lags.

Elsewhere a time lag is a `delay`, in seconds. Here a `lag` is in samples, as in the field ``lags``
of the model document. It may contain unknown parameters.
"""
