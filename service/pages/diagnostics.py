"""Figure of the residual tests of a run."""

from typing import TYPE_CHECKING

from sysid.figures.plotly import Figure
from sysid.figures.residuals import plot_residuals
from sysid.results.figures import to_correlation_trace

if TYPE_CHECKING:  # a report without a database has diagnostics too
    from service.runs.residuals import ResidualAnalysis


def plot_residual_tests(tested: "ResidualAnalysis", experiment: int, columns: int = 2) -> Figure:
    """Draw the residual correlations of one experiment; empty if none was tested."""
    functions = [
        to_correlation_trace(correlation)
        for correlation in tested.correlations
        if correlation.test.experiment == experiment and correlation.values.size
    ]
    return plot_residuals(functions, columns, tested.experiments)
