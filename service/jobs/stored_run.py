"""Stored run: its rows, its own request, and its model.

It is in `jobs` because a run's request is its job's. Everything that uses runs is in higher layers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from sqlalchemy.orm import Session

from service.core.bodies.json_pointer import build_run_body
from service.core.errors import Conflict
from service.datasets.rms_unit import find_rms_unit
from service.datasets.signal_channels import SignalChannels, map_channels
from service.datasets.stored_recordings import read_records
from service.jobs.job_parameters import list_job_parameters
from service.jobs.stored_results import read_result_document
from service.jobs.to_core import read_fit, read_noise
from service.models.models import apply_result, load_stored_model
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.job_rows import JobRepository
from service.repositories.run_rows import RunRepository
from service.storage.objects import ObjectStore
from service.storage.tables import Job, Run
from sysid.data.records import Record
from sysid.models.kalman_filter import is_noise_parameter
from sysid.models.model import Model, build_initial_parameters
from sysid.models.parameters import Parameter, override_parameters
from sysid.models.starts import replace_starts
from sysid.results.result import Result
from sysid.uncertainty.estimates import Estimate

if TYPE_CHECKING:
    from sysid.core.settings import FitSettings
    from sysid.identification.fit_problems import FitRecords
    from sysid.identification.resimulate import FittedSignals
    from sysid.simulation.problem import Problem


@dataclass(frozen=True, eq=False)
class StoredRun:
    """Stored run with its request and model.

    Attributes
    ----------
    body : mapping
        The job's request with the values of the run's cell in it.
    model : Model
        With the terms that were selected on the run's data, and the substeps of its result. A run
        that selects terms has all candidates and a `rule` until it has a result.
    """

    job: Job
    run: Run
    body: Mapping[str, Any]
    model: Model

    @classmethod
    def from_rows(cls, job: Job, run: Run) -> "StoredRun":
        """Build the value from the rows of a run and its job."""
        body = build_run_body(job.spec, run.cell)
        started = replace_starts(load_stored_model(body["model"]), body.get("initial"))
        return cls(job, run, body, apply_result(started, run.result))

    @property
    def model_of_request(self) -> Model:
        """The model as requested, with all its candidate terms."""
        return load_stored_model(self.body["model"])

    @property
    def model_of_other_records(self) -> Model:
        """The model of the result for records that need not start as the fitted ones do.

        If the data told how those start, they tell nothing of others.
        """
        started = replace_starts(self.model_of_request, self.body.get("initial"))
        return apply_result(started, {**self.document, "initial": None})

    @property
    def document(self) -> Mapping[str, Any]:
        """The stored document: the result, and what computed it; empty until there is one."""
        return self.run.result or {}

    @cached_property
    def result(self) -> Result | None:
        """The result; None until there is one."""
        return None if self.run.result is None else read_result_document(self.run.result)

    @property
    def estimates(self) -> Sequence[Estimate]:
        """The estimates of the result; none until there is one."""
        return () if self.result is None else self.result.parameters

    @property
    def channels(self) -> SignalChannels:
        """The channels of the model's signals, and how the job holds its inputs."""
        return map_channels(self.model, self.body["channels"], self.body["hold"])

    def rms_unit(self, session: Session) -> str:
        """Find the unit of the RMS."""
        return find_rms_unit(session, self.body)

    def parameters(self, session: Session) -> tuple[Parameter, ...]:
        """List all parameters with the job's changes, and the initial states of all experiments."""
        parameters = list_job_parameters(session, self.model, self.body)
        return override_parameters(parameters, self._changes(parameters))

    def read_datasets(
        self, session: Session, store: ObjectStore, datasets: Sequence[str]
    ) -> tuple[Record, ...]:
        """Read datasets as records of the model, held as the job says.

        Raises
        ------
        NotFound, ObjectMissing, InvalidRecord
            If a dataset is not there, or has no such channel.
        """
        rows = DatasetRepository(session, self.job.project_id).get_all(datasets)
        return read_records(store, rows, self.channels)

    def read_fit_records(self, session: Session, store: ObjectStore) -> "FitRecords":
        """Read the records that the run was fitted to, noise added, and its validation data."""
        # This imports the compiler.
        from sysid.identification.fit_problems import prepare_records

        validation = self.body["validation"] or {}
        others = validation.get("datasets")
        return prepare_records(
            self.model_of_request,
            self.read_datasets(session, store, self.body["datasets"]),
            None if others is None else self.read_datasets(session, store, others),
            validation.get("fraction"),
            read_noise(self.body),
        )

    def problem(self, session: Session, store: ObjectStore) -> "Problem":
        """Build the problem that the run solved."""
        # This imports the compiler.
        from sysid.simulation.problem import Problem

        records = self.read_fit_records(session, store).estimation
        parameters = (*self.model.parameters, *build_initial_parameters(self.model, len(records)))
        changes = self.body["parameters"]
        noise = {name: change for name, change in changes.items() if is_noise_parameter(name)}
        settings = self._read_settings({**self._changes(parameters), **noise})
        return Problem.from_settings(self.model, records, settings)

    def resimulate(
        self, session: Session, store: ObjectStore
    ) -> "tuple[FitRecords, FittedSignals]":
        """Compute the fitted signals of a successful run again, bit for bit.

        Returns the records of the fit too.

        Raises
        ------
        SysidError, StorageError, ServiceError
            If a dataset is not there any more, or has no such channel.
        """
        # This imports the compiler.
        from sysid.identification.resimulate import resimulate_run

        model, records = self.model_of_request, self.read_fit_records(session, store)
        substeps = model.solver.substeps if self.result is None else self.result.substeps
        initial = None if self.result is None else self.result.initial
        settings = self._read_settings(self.body["parameters"])
        return records, resimulate_run(model, records, settings, self.estimates, substeps, initial)

    def _read_settings(self, changes: Mapping[str, Any]) -> "FitSettings":
        """Read the settings of the fit, with the noise and the commands that the result found.

        `changes` are those of parameters.
        """
        result = self.result
        loss = {**self.body["loss"], "noise_model": result.noise_model if result else "white"}
        settings = read_fit({**self.body, "parameters": changes, "loss": loss})
        if result is not None and result.commands:
            settings = replace(settings, commands=result.commands)
        if result is not None and result.noise_deviations is not None:
            settings = replace(settings, deviations=result.noise_deviations)
        return settings

    def _changes(self, parameters: Sequence[Parameter]) -> dict[str, Any]:
        """Select the changes of these parameters. The request may name unselected terms."""
        names = {parameter.name for parameter in parameters}
        return {name: change for name, change in self.body["parameters"].items() if name in names}


def load_run(session: Session, run_id: str) -> StoredRun:
    """Load a run with its job.

    Raises
    ------
    NotFound
        If there is no such run.
    """
    run = RunRepository(session).get(run_id)
    return StoredRun.from_rows(JobRepository(session).get(run.job_id), run)


def load_estimated_run(session: Session, run_id: str, purpose: str) -> StoredRun:
    """Load a run that has estimates.

    Parameters
    ----------
    purpose : str
        Purpose of the estimates for the message: "to …".

    Raises
    ------
    NotFound
        If there is no such run.
    Conflict
        If it has no estimates.
    """
    stored = load_run(session, run_id)
    if not stored.estimates:
        state = stored.run.state.value
        raise Conflict(f"run {run_id} is {state} and has no estimates to {purpose}")
    return stored
