"""Regression on measured past values: selecting a polynomial's terms, and starting its search."""

from sysid.selection.select import selected
from sysid.selection.starts import Starts, equation_error_starts

__all__ = ["Starts", "equation_error_starts", "selected"]
