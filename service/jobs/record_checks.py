"""Checks of records and settings before a job runs: channels, units, lengths, conflicts.

They need no database, so that the command line checks as the service does.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from service.core.errors import FieldError, to_field_errors
from service.datasets.signal_channels import map_channels
from service.jobs.to_core import read_algorithm, read_fit
from sysid.core.errors import RecordTooShort, SysidError, suggest_name
from sysid.core.settings import FILTERED
from sysid.data.holds import MEANS
from sysid.data.records import find_shared_channels
from sysid.language.delays import has_varying_delay
from sysid.models.channel_assignment import check_commands, check_holds
from sysid.models.kalman_filter import (
    check_noise_changes,
    is_noise_parameter,
    list_noise_parameters,
)
from sysid.models.model import Model
from sysid.models.model_delays import check_record_length, compute_longest_delay, list_past_values
from sysid.models.parameters import Parameter, override_parameters
from sysid.models.sections import get_interval
from sysid.models.unit_checks import SignalUnits
from sysid.simulation.output_means import check_mean_output

if TYPE_CHECKING:
    from service.storage.tables import Dataset


@dataclass(frozen=True, slots=True)
class RecordLength:
    """Length of one record; `part` names the part that is meant."""

    duration: float
    samples: int
    period: float | None
    part: str = ""

    def take_estimation_part(self, fraction: float) -> "RecordLength | None":
        """Return the estimation part; None if it or the validation part has no sample."""
        left = self.samples - round(fraction * self.samples)
        if not 0 < left < self.samples:
            return None
        # The cut of an irregular record is unknown here, so its whole length is checked.
        duration = self.duration if self.period is None else (left - 1) * self.period
        return RecordLength(duration, left, self.period, "estimation part: ")


def list_signals(model: Model) -> tuple[list[str], list[str]]:
    """List the names of a model's inputs and outputs, to which channels are mapped."""
    return [signal.name for signal in model.inputs], [signal.name for signal in model.outputs]


def find_channel_faults(
    channels: Mapping[str, str], model: Model, dataset: "Dataset"
) -> Iterator[FieldError]:
    """Report signals of the model for which a dataset has no channel."""
    recorded = [channel["name"] for channel in dataset.channels]
    for signal, channel in map_channels(model, channels).by_signal.items():
        if channel not in recorded:
            yield FieldError(
                f"/channels/{signal}" if signal in channels else "/channels",
                f"dataset {dataset.id} ({dataset.name}) has no channel {channel!r} for signal "
                f"{signal!r} of the model{suggest_name(channel, recorded)}",
            )


def find_channels_given_twice(channels: Mapping[str, str], model: Model) -> Iterator[FieldError]:
    """Report inputs that are mapped to the channel of an output."""
    mapped = map_channels(model, channels)
    for signal, fault in find_shared_channels(dict(mapped.inputs), dict(mapped.outputs)).items():
        yield FieldError(f"/channels/{signal}" if signal in channels else "/channels", fault)


def find_unit_faults(
    model: Model, channels: Mapping[str, str], datasets: "Sequence[tuple[str, Dataset]]"
) -> Iterator[FieldError]:
    """Report channels whose unit differs from the model's or from an earlier dataset's.

    Parameters
    ----------
    datasets : sequence of (str, Dataset)
        Each with its pointer in the job body.
    """
    units = SignalUnits(model)
    by_signal = map_channels(model, channels).by_signal
    for pointer, dataset in datasets:
        recorded_units = {channel["name"]: channel["unit"] for channel in dataset.channels}
        for signal, channel in by_signal.items():
            fault = units.describe_mismatch(
                signal, channel, recorded_units.get(channel), f"dataset {dataset.name!r}"
            )
            if fault:
                yield FieldError(pointer, fault)


def list_record_lengths(dataset: "Dataset") -> list[RecordLength]:
    """List the lengths of a dataset's records: its segments, or the whole dataset."""
    period = dataset.sample_time
    spans = [segment["stop"] - segment["start"] for segment in dataset.details["segments"]]
    if not spans:
        return [RecordLength(dataset.duration, dataset.n_samples, period)]
    if period is None:  # samples per segment are not stored: the total suffices
        return [RecordLength(min(spans), dataset.n_samples, None)]
    return [RecordLength(span, round(span / period) + 1, period) for span in sorted(set(spans))]


def find_length_faults(
    pointer: str, model: Model, parameters: tuple[Parameter, ...], piece: RecordLength, skip: int
) -> Iterator[FieldError]:
    """Report delays longer than a record, and a record shorter than the model's memory."""
    period = model.solver.step or piece.period or piece.duration / max(piece.samples - 1, 1)
    substeps = model.solver.substeps
    error = _check_longest_delay(model, parameters, period / substeps, piece.duration)
    if error is not None:
        yield FieldError(pointer, f"{piece.part}{error}")
    if (piece.samples - 1 - skip) * substeps < model.memory:
        yield FieldError(
            pointer,
            f"{piece.part}the record has {piece.samples} samples, too few for the model's memory "
            f"({model.memory}) and 'skip' ({skip})",
        )


def _check_longest_delay(
    model: Model, parameters: tuple[Parameter, ...], step: float, duration: float
) -> RecordTooShort | None:
    """Return the error of the longest delay that is too long."""
    if not duration > 0:
        return RecordTooShort(duration, 0.0, "a simulation")
    spans = {p.name: get_interval(p) for p in parameters}
    for parameter in parameters:
        if parameter.bounds == "delay" and parameter.is_free:
            lower, upper = spans[parameter.name]
            spans[parameter.name] = (lower, min(upper, max(lower, duration / 2)))
    lagged = sorted(  # a lag that changes with an input is checked with the input's data
        (past for past in list_past_values(model) if not has_varying_delay(past)),
        key=lambda past_value: -compute_longest_delay(model, past_value, spans, step),
    )
    try:
        for past in lagged:
            check_record_length(model, past, spans, step, duration)
    except RecordTooShort as error:
        return error
    return None


JobBody = dict[str, Any]


def find_signal_faults(body: JobBody, model: Model) -> Iterator[FieldError]:
    """Report channels, holds and weights of signals that the model does not have."""
    inputs, outputs = (
        [signal.name for signal in model.inputs],
        [signal.name for signal in model.outputs],
    )
    for name in body["channels"]:
        if name not in (*inputs, *outputs):
            hint = suggest_name(name, (*inputs, *outputs))
            yield FieldError(
                f"/channels/{name}", f"model {model.name!r} has no signal {name!r}{hint}"
            )
    for name, hold in body["hold"].items():
        faults: list[FieldError] = []
        collect_faults(check_holds, faults, model, {name: hold})
        if name in outputs and hold in MEANS:
            collect_faults(check_mean_output, faults, model, name, body["prediction"])
        yield from faults
    unknown: list[FieldError] = []
    collect_faults(check_commands, unknown, model, body["commands"])
    yield from unknown
    for name, weight in (body["weights"] or {}).items():
        numbers = weight if isinstance(weight, list) else [weight]
        if name not in outputs:
            hint = suggest_name(name, outputs)
            yield FieldError(f"/weights/{name}", f"the model has no output {name!r}{hint}")
        elif not min(numbers, default=0.0) > 0:
            detail = f"found {min(numbers, default=0.0):g}; need a positive number"
            yield FieldError(f"/weights/{name}", detail)


def find_weight_count_faults(body: JobBody, experiments: int) -> Iterator[FieldError]:
    """Report lists of weights that have not one number for each experiment."""
    for name, weight in (body["weights"] or {}).items():
        if isinstance(weight, list) and len(weight) != experiments:
            yield FieldError(
                f"/weights/{name}",
                f"found {len(weight)} weights; need one for each of the {experiments} "
                "experiments, or one number",
            )


def find_setting_conflicts(body: JobBody) -> list[FieldError]:
    """Report settings of search and fit that conflict."""
    faults: list[FieldError] = []
    collect_faults(read_algorithm, faults, body)
    collect_faults(read_fit, faults, body)
    return faults


def find_setting_faults(
    body: JobBody, model: Model, parameters: tuple[Parameter, ...]
) -> list[FieldError]:
    """Report faults that the model reveals: unknown names and invalid values."""
    faults = find_setting_conflicts(body)
    override_by_request(faults, model, parameters, body)
    return [*faults, *find_signal_faults(body, model)]


def override_by_request(
    errors: list[FieldError], model: Model, parameters: tuple[Parameter, ...], body: JobBody
) -> tuple[Parameter, ...]:
    """Apply all valid parameter changes, and collect the faults of the others.

    The parameters of a filter that the body asks for are added.
    """
    noise = body["loss"]["noise_model"]
    parameters = (*parameters, *(collect_faults(list_noise_parameters, errors, model, noise) or ()))
    for name, change in body["parameters"].items():
        if is_noise_parameter(name) and noise not in FILTERED:
            collect_faults(check_noise_changes, errors, [name], noise)
            continue
        parameters = (
            collect_faults(override_parameters, errors, parameters, {name: change}) or parameters
        )
    return parameters


def collect_faults(make: Any, errors: list[FieldError], *arguments: Any) -> Any:
    """Call `make` and return its result. If it raises, return None and append to `errors`."""
    try:
        return make(*arguments)
    except SysidError as error:
        errors += to_field_errors(error)
        return None
