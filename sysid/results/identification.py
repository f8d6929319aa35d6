"""Identification: the result that a user has, with what can be done with it."""

from collections.abc import ItemsView, Iterator, KeysView, Mapping, Sequence, ValuesView
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any

from sysid.core.errors import InvalidSettings, UnknownParameter
from sysid.data.records import Record
from sysid.figures.theme import Theme
from sysid.results.figures import FigureName, plot_result
from sysid.results.result import FullResult
from sysid.results.saved_result import have_same_content, read_result, write_result
from sysid.results.summary import summarise_result, to_frame, to_html
from sysid.uncertainty.estimates import Estimate

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from sysid.data.records import Channels, Recording
    from sysid.uncertainty.disturbances import Disturbance
    from sysid.uncertainty.output_bands import OutputBands


@dataclass(frozen=True, slots=True, eq=False, repr=False, kw_only=True)
class Identification(FullResult):
    """The result of one identification.

    In a notebook it shows a table of the estimates, the fit, the verdicts and the warnings. Its
    fields are those of `Result`, which the REST interface sends, and of `FullResult`.

    Examples
    --------
    >>> t = [0.1 * k for k in range(100)]
    >>> u = [1.0 if time >= 1 else 0.0 for time in t]
    >>> y = [3 * (1 - 2.718281828 ** -(time - 1.5)) if time > 1.5 else 0.0 for time in t]
    >>> found = identify("fopdt", {"t": t, "u": u, "y": y})
    >>> found["K"].status
    'identified'
    >>> sorted(found.parameter_values)
    ['K', 'L', 'T', 'x(0)', 'y0']
    """

    def __getitem__(self, name: str) -> Estimate:
        """Return the estimate of a parameter.

        Raises
        ------
        UnknownParameter
            If there is none; the message suggests the nearest.
        """
        for estimate in self.parameters:
            if estimate.name == name:
                return estimate
        raise UnknownParameter(name, list(self))

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the parameters, so that ``"L" in found`` holds."""
        return (estimate.name for estimate in self.parameters)

    def __len__(self) -> int:
        """Return the number of parameters."""
        return len(self.parameters)

    def keys(self) -> KeysView[str]:
        """Return the names of the parameters."""
        return self._by_name().keys()

    def values(self) -> ValuesView[Estimate]:
        """Return the estimates."""
        return self._by_name().values()

    def items(self) -> ItemsView[str, Estimate]:
        """Return the names of the parameters with their estimates."""
        return self._by_name().items()

    def get(self, name: str, default: Estimate | None = None) -> Estimate | None:
        """Return the estimate of a parameter, or a default if there is none."""
        return self._by_name().get(name, default)

    def _by_name(self) -> dict[str, Estimate]:
        return {estimate.name: estimate for estimate in self.parameters}

    def __eq__(self, other: object) -> bool:
        """Test whether every number, name and record is the same; ``nan`` is equal to ``nan``."""
        if not isinstance(other, Identification):
            return NotImplemented
        return self is other or have_same_content(self, other)

    def __hash__(self) -> int:
        return hash((self.evaluations, self.generations, tuple(self)))

    def __repr__(self) -> str:
        return summarise_result(self)

    def _repr_html_(self) -> str:
        return to_html(self)

    def plot(
        self,
        *names: FigureName | Sequence[FigureName],
        experiment: int = 0,
        theme: Theme = "light",
    ) -> Any:
        """Draw figures one below the other, as a figure of Plotly.

        Without names: measured against identified output with the residuals, the estimated
        disturbances if there are any, correlation functions of the residuals, the correlation of
        the estimates, and what each island of the search found.

        Parameters
        ----------
        *names : {"response", "disturbances", "residuals", "correlation", "waterfall", "history", \
"convergence", "posterior"}
            The figures to draw, also as a list.
        experiment : int
            Which record, from 0, if there are several.
        theme : {"light", "dark"}

        Raises
        ------
        MissingLibrary
            If Plotly is not installed.
        InvalidSettings
            If there is no such figure, record or theme, or a named figure has no data.
        """
        return plot_result(self, names, experiment, theme)

    def compute_bands(
        self,
        inputs: "Channels | Record | Recording | None" = None,
        *,
        channels: Mapping[str, str] | None = None,
        times: "ArrayLike | None" = None,
        experiment: int = 0,
    ) -> "tuple[OutputBands, ...]":
        """Compute 95 % bands of each output, on a record of the fit or on new inputs.

        The confidence band holds the output without noise, the prediction band a new measurement.
        Both come from the covariance of the estimates, or from the posterior where it was sampled.

        Parameters
        ----------
        inputs : Channel, sequence of Channel, table, Record or Recording, optional
            New inputs, as `simulate` takes them. Default: the record that was fitted.
        channels : mapping of str to str, optional
            Model's input → channel's name.
        times : array of shape (N,), optional
            Seconds. Default: the times of the first input.
        experiment : int
            Which record of the fit, from 0, if there are several.

        Returns
        -------
        tuple of OutputBands
            In the units of the outputs, (N, 2) each.

        Raises
        ------
        InvalidSettings
            If the result has no standard errors, or there is no such record.
        InvalidRecord, RecordTooShort
            If new inputs cannot be simulated.

        Examples
        --------
        >>> t = [0.1 * k for k in range(100)]
        >>> u = [1.0 if time >= 1 else 0.0 for time in t]
        >>> y = [3 * (1 - 2.718281828 ** -(time - 1.5)) if time > 1.5 else 0.0 for time in t]
        >>> found = identify("fopdt", {"t": t, "u": u, "y": y})
        >>> [bands] = found.compute_bands()
        >>> bands.output, bands.confidence.shape, bands.source
        ('y', (100, 2), 'covariance')
        """
        from sysid.results.bands import compute_bands  # it imports the compiler

        return compute_bands(self, inputs, channels=channels, times=times, experiment=experiment)

    def compute_disturbances(self, experiment: int = 0) -> "tuple[Disturbance, ...]":
        """Compute the disturbances over time, with 95 % bands, if noise acts inside the plant.

        They are the loads, and the states that noise moves. Each time is estimated from the whole
        record, those after it included.

        Parameters
        ----------
        experiment : int
            Which record of the fit, from 0, if there are several.

        Returns
        -------
        tuple of Disturbance
            In the units of their places.

        Raises
        ------
        InvalidSettings
            If no noise acts inside the plant, if the result has no standard errors, or if there is
            no such record.
        """
        from sysid.results.bands import compute_disturbances  # it imports the compiler

        records = compute_disturbances(self)
        if not 0 <= experiment < len(records):
            detail = f"found {experiment!r}; the result has disturbances of {len(records)} records"
            raise InvalidSettings("/experiment", detail)
        return records[experiment]

    def to_pandas(self) -> Any:
        """Return the estimates as a table of pandas, one row for each parameter.

        Raises
        ------
        MissingLibrary
            If pandas is not installed.
        """
        return to_frame(self)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the result with model and records to a JSON file.

        Raises
        ------
        UnwritableFile
            If the file cannot be written.
        """
        write_result(self, path)

    @staticmethod
    def load(path: str | PathLike[str]) -> "Identification":
        """Read a result that `save` wrote; it is equal to the one that was saved.

        Raises
        ------
        UnreadableResult
            If the file cannot be read, or is something else.
        """
        return read_result(path, Identification)
