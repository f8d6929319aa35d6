"""Identification of nonlinear systems with unknown time lags: the numerical core."""

from sysid.errors import SysidError
from sysid.identify import identify
from sysid.models.library import catalogue, load_model
from sysid.noise import Noise
from sysid.parameters import Parameter
from sysid.problem import Problem
from sysid.records import Channel, Record, Recording
from sysid.result import Estimate, Identification
from sysid.settings import GeneticAlgorithm, IslandChange, Loss, Migration, SequenceSearch, Stop

__all__ = [
    "Channel", "Estimate", "GeneticAlgorithm", "Identification", "IslandChange", "Loss",
    "Migration", "Noise", "Parameter", "Problem", "Record", "Recording", "SequenceSearch", "Stop",
    "SysidError", "catalogue", "identify", "load_model",
]  # fmt: skip
