"""Types of the answers of the REST interface, written by `make openapi`. Do not edit.

They are dictionaries with the field names of the interface, for type checkers and editors.
"""

# ruff: noqa: E501

from typing import Any, Literal, NotRequired, TypedDict

class AcceptanceDocument(TypedDict):
    """One acceptance."""

    run: str
    """id of the accepted run"""
    by: NotRequired[str | None]
    """who accepted it"""
    note: NotRequired[str | None]
    """why it was accepted"""
    at: str
    """time of the acceptance, UTC"""

class AccessDocument(TypedDict):
    """Who asks, in which project, and what it may do."""

    actor: str
    """who sends the request: a key, a user of the proxy, or `loopback`"""
    project: str
    """id of the project"""
    project_name: str
    """name of the project"""
    scopes: list[str]
    """what the caller may do: read, write, admin"""
    limits: LimitsDocument
    """limits of the project"""
    used: UseDocument
    """what the project uses of them"""

class AgreementDocument(TypedDict):
    """Fit of one output of one experiment (counted from 1); null if the output does not vary."""

    experiment: int
    """record, from 1"""
    output: str
    """output of the model"""
    unit: str
    """unit of the RMS"""
    samples: int
    """scored samples"""
    rms: float | None
    """RMS error, in `unit`"""
    fit_percent: float | None
    """fit, %; not a number if the output does not vary"""
    span: list[float | None]
    """least and largest measured value, in `unit`. The estimate holds for such amplitudes"""
    line_rms: float | None
    """RMS error of a straight line through the samples, in `unit`; not a number for less than three"""

class AgreementsDocument(TypedDict):
    """Agreement of each output of each record."""

    estimation: list[ChannelMetricsDocument]
    """with the estimation data"""
    validation: list[ChannelMetricsDocument]
    """with the validation data"""

class AlgorithmInDocument(TypedDict):
    """Settings of the search."""

    method: NotRequired[Literal["simple", "improved-paper", "improved"]]
    """the paper's two methods as printed, or ours"""
    population: NotRequired[int]
    """individuals of all islands together, distributed as evenly as possible. The budget of evaluations does not depend on the number of islands"""
    generations: NotRequired[int]
    """most generations"""
    bits: NotRequired[int]
    """bits of each parameter in the chromosome"""
    selection_rate: NotRequired[float]
    """share of an island that survives"""
    mutation: NotRequired[list[list[int | float]]]
    """pairs of a generation and, from it on, the probability of one flipped bit in a child. The first generation is 0"""
    stagnation: NotRequired[int]
    """generations without a better champion before the sequence search, or a restart, begins"""
    sequence: NotRequired[SequenceInDocument]
    """settings of the sequence search"""
    islands: NotRequired[int | list[IslandInDocument] | None]
    """number of islands, or the settings of each. null: 4 for `improved` with 16 individuals or more, else 1. The paper has no islands"""
    migration: NotRequired[MigrationInDocument]
    """exchange between islands"""
    refine: NotRequired[bool]
    """whether least squares continues from the champions of `improved`"""
    safe_limit: NotRequired[float | None]
    """RMS error above which a result is not valid (section 3 of the paper), in the output's unit"""
    stop: NotRequired[StopInDocument]
    """what ends the search before the last generation, whichever comes first"""

class AuditEntryDocument(TypedDict):
    """One action: who did what to which object."""

    id: int
    """number of the entry; later ones are larger"""
    at: str
    """when it was done, UTC"""
    actor: str
    """who did it, as in `GET /v1/access`"""
    action: str
    """what was done, such as `job.submit`"""
    object_id: str
    """id of what was changed"""
    request_id: str | None
    """id of the request that did it"""

class AuditPageDocument(TypedDict):
    """Entries of the audit log, latest first."""

    items: list[AuditEntryDocument]
    """items of this page, in the order of the list"""
    next: NotRequired[str | None]
    """cursor of the following page; null on the last one"""

class BandExperimentDocument(TypedDict):
    """Bands of all outputs of one record."""

    name: str
    """name of the record"""
    outputs: list[BandDocument]
    """bands of each output"""

class BandDocument(TypedDict):
    """95 % bands of one output, in `unit`; null where the simulation diverged."""

    name: str
    """name of the output"""
    unit: str
    """unit of all values"""
    samples: int
    """samples before the reduction"""
    times: list[float]
    """times, s"""
    simulated: list[float | None]
    """output at the estimates"""
    confidence_lower: list[float | None]
    """lower end for the output itself"""
    confidence_upper: list[float | None]
    """upper end for the output itself"""
    prediction_lower: list[float | None]
    """lower end for a new measurement"""
    prediction_upper: list[float | None]
    """upper end for a new measurement"""

class BandsDocument(TypedDict):
    """95 % bands of the outputs on the records that the run was fitted to."""

    id: str
    """identifier of the run"""
    source: Literal["covariance", "posterior"]
    """covariance of the estimates, or samples of the posterior"""
    experiments: list[BandExperimentDocument]
    """records of the run"""

class BatchLabelDocument(TypedDict):
    """All runs of one label."""

    x: float
    """value of the label"""
    runs: list[str]
    """identifiers of the runs"""
    evaluations: int
    """simulations of these runs"""
    spans: list[SpanDocument]
    """measured range of each output"""
    flags: list[str]
    """what speaks against these runs, in a few words each"""
    warnings: list[str]
    """warnings of these runs"""

class ChannelMetricsDocument(TypedDict):
    """Agreement of one output of one experiment, over its scored samples."""

    experiment: int
    """record, from 0"""
    output: str
    """output of the model"""
    unit: str
    """unit of the RMS"""
    samples: int
    """scored samples"""
    rms: float | None
    """RMS error, in `unit`"""
    fit_percent: float | None
    """fit, %; not a number if the output does not vary"""
    span: list[float | None]
    """least and largest measured value, in `unit`. The estimate holds for such amplitudes"""
    line_rms: float | None
    """RMS error of a straight line through the samples, in `unit`; not a number for less than three"""

class ChannelDocument(TypedDict):
    """One channel of a dataset. `sample_time` is null if the sampling is irregular."""

    name: str
    """name of the channel"""
    unit: str
    """unit of its values; empty if unknown"""
    hold: str
    """how it is read between its samples"""
    samples: int
    """number of samples"""
    start: float
    """time of the first sample, s"""
    stop: float
    """time of the last sample, s"""
    sample_time: float | None
    """sampling period, s; null if irregular"""
    missing: int
    """samples without a value"""
    history_samples: int
    """samples before `start`"""
    history_start: float | None
    """time of the first of them, s; null if there is none"""

class CheckDocument(TypedDict):
    """Result of a check: whether a model document is valid, and every error in it."""

    valid: bool
    """whether the document is a model"""
    errors: list[FaultDocument]
    """every fault of the document"""
    warnings: NotRequired[list[FaultDocument]]
    """what is declared in a valid document but used nowhere"""
    normal_form: NotRequired[ModelDocumentDocument | None]
    """document with every default; null if it has faults"""
    equations: NotRequired[list[EquationDocument]]
    """equations, intermediate names, outputs; empty if it has faults"""

class CoefficientDocument(TypedDict):
    """One coefficient of a law."""

    name: str
    """name of the coefficient in the formula"""
    value: float
    """value, in the units of the law"""
    stderr: float
    """standard error of the value"""

class ComparedParameterDocument(TypedDict):
    """Parameter that at least two runs have."""

    name: str
    """name of the parameter"""
    unit: str
    """unit of its values"""
    values: list[ComparedValueDocument]
    """estimate of each run that has it"""
    differs: bool | None
    """whether two 95 % intervals do not overlap; null if fewer than two have one"""
    note: str
    """what limits the comparison; empty if nothing"""

class ComparedRunDocument(TypedDict):
    """Candidate of a comparison; `parameters` counts the free ones. Low AIC and BIC are better."""

    run: str
    """identifier of the run"""
    job: str
    """identifier of its job"""
    number: int
    """number of the run in its job, from 0"""
    model: str
    """name of the model"""
    title: str
    """title of the model"""
    cell: dict[str, Any]
    """values of the sweep's axes, by their pointers"""
    parameters: int
    """number of free parameters"""
    samples: int
    """scored samples"""
    rms: float | None
    """RMS error on the estimation data, in `unit`"""
    rms_validation: float | None
    """RMS error on the validation data, in `unit`"""
    fit_estimation: float | None
    """fit to the estimation data, %"""
    fit_validation: float | None
    """fit to the validation data, %"""
    aic: float | None
    """Akaike's information criterion"""
    bic: float | None
    """Schwarz's information criterion"""
    residuals_passed: bool | None
    """whether the residual tests passed; null if not tested"""
    residuals_data: str | None
    """data of the residual tests"""
    evaluations: int
    """simulations of the search"""

class ComparedValueDocument(TypedDict):
    """Estimate of a parameter by one run."""

    run: str
    """identifier of the run"""
    name: str
    """name of the parameter, or of an initial state such as `x(0)`"""
    unit: str
    """unit of its values"""
    value: float | None
    """estimate, in `unit`"""
    lower: float | None
    """lower bound of the search, in `unit`"""
    upper: float | None
    """upper bound of the search, in `unit`"""
    stderr: float | None
    """standard error, in `unit`. If there is none, `reason` says why"""
    interval95: list[float | None] | None
    """both ends of the 95 % interval, in `unit`"""
    status: Literal[
        "identified",
        "not settled",
        "refuted",
        "dependent",
        "ambiguous",
        "group",
        "at bound",
        "unidentifiable",
        "fixed",
        "tied",
        "unfinished",
    ]
    """identified, or why the value is not to be relied on"""
    reason: str
    """reason of the status, or of a missing standard error; empty if there is nothing to say"""
    open_ends: list[Literal["lower", "upper"]]
    """ends of the interval up to which the data speak for any value; there it ends at the bound"""

class ComparisonDocument(TypedDict):
    """Comparison of runs, the best first; `unit` is that of the RMS."""

    unit: str
    """unit of each RMS"""
    runs: list[ComparedRunDocument]
    """runs, the best first"""
    parameters: list[ComparedParameterDocument]
    """parameters that at least two runs have"""
    notes: list[str]
    """what does not compare"""

class ControllerDocument(TypedDict):
    """Controller as it was used, set by hand or by a rule, and its command."""

    gain: float
    """gain, in units of the input per unit of the output"""
    integral_time: float | None
    """integral time, s; null without integral"""
    derivative_time: float
    """derivative time, s"""
    derivative_filter: float
    """ratio of the derivative time to that of its filter"""
    derivative_on: str
    """what the derivative acts on"""
    setpoint_weight: float
    """weight of the reference in the proportional part"""
    lower: float | None
    """least command, in the input's unit"""
    upper: float | None
    """largest command, in the input's unit"""
    tracking_time: float | None
    """time that resets the integral at a limit, s"""
    command_min: float
    """least command that occurred, in the input's unit"""
    command_max: float
    """largest command that occurred, in the input's unit"""
    saturated_percent: float
    """share of the samples at a limit, %"""

class CorrelationMatrixDocument(TypedDict):
    """Correlation matrix; its rows and columns are `names`."""

    names: list[str]
    """free parameters of the rows and columns"""
    matrix: list[list[float | None]]
    """rows of the matrix"""

class CorrelationDocument(TypedDict):
    """Correlation function of residuals with its bands, and its test."""

    period: float | None
    """time between two lags, s; null for irregular times"""
    lags: list[float]
    """lags, in periods or samples"""
    values: list[float]
    """correlation at each lag, from -1 to 1"""
    band95: list[float]
    """half width of the 95 % band at each lag"""
    band99: list[float]
    """half width of the 99 % band at each lag"""
    experiment: int
    """record, from 0"""
    output: str
    """output whose residuals are tested"""
    test: Literal["whiteness", "independence"]
    """whiteness: with their own past. Independence: with an input"""
    input: str | None
    """input of the test; none for whiteness"""
    outcome: Literal["passed", "failed", "not tested"]
    """outcome of the test"""
    samples: int
    """scored residuals of the test"""
    lags_tested: int
    """lags of the statistic"""
    inside95: float | None
    """share of the tested lags within the 95 % band"""
    inside99: float | None
    """share of the tested lags within the 99 % band"""
    statistic: float | None
    """test statistic, χ² distributed if the model is true"""
    degrees: float | None
    """degrees of freedom of the statistic"""
    p: float | None
    """probability of a larger statistic if the model is true"""
    reason: str
    """why it was not tested, or what failed"""

class CovarianceDocument(TypedDict):
    """Covariance of the free parameters, in products of their units."""

    names: list[str]
    """parameters of the rows and columns"""
    matrix: list[list[float | None]]
    """rows of the matrix"""

class CriteriaDocument(TypedDict):
    """Information criteria, smaller is better; compare only models of the same samples."""

    aic: float | None
    """criterion of Akaike; minus infinity where the residuals vanish"""
    aicc: float | None
    """the same, corrected for few samples; missing if there are not more than κ + 1"""
    bic: float | None
    """criterion of Schwarz; minus infinity where the residuals vanish"""
    samples: int
    """number n of scored samples"""
    parameters: int
    """number D of free parameters"""

class DatasetCheckDocument(TypedDict):
    """What happened to a recording: gaps, stamps, repeated and coarse values, limits and more."""

    id: str
    """identifier of the dataset"""
    findings: list[FindingDocument]
    """what was found, each with its channels and where it is"""

class DatasetDocument(TypedDict):
    """A stored recording."""

    id: str
    """identifier, `ds_…`"""
    name: str
    """name of the dataset"""
    kind: str
    """how it was made: upload, simulate or derive"""
    sha256: str
    """SHA-256 of the stored MCAP file, in hexadecimal"""
    size_bytes: int
    """size of the stored MCAP file, bytes"""
    channels: list[ChannelDocument]
    """channels of the recording"""
    samples: int
    """samples of the longest channel"""
    duration: float
    """time from the first to the last sample, s"""
    sample_time: float | None
    """sampling period of all channels, s; null if irregular"""
    started_at: NotRequired[str | None]
    """time 0 s on the clock that recorded, ISO 8601; without a zone it is local"""
    segments: list[SegmentDocument]
    """parts that are identified as separate experiments"""
    warnings: list[str]
    """what was guessed or is doubtful"""
    details: dict[str, Any]
    """how it was made"""
    note: NotRequired[str | None]
    """note of a user"""
    tags: NotRequired[list[str]]
    """tags of users"""
    created_at: str
    """time of the upload, UTC"""

class DatasetPageDocument(TypedDict):
    """Datasets, latest first."""

    items: list[DatasetDocument]
    """items of this page, in the order of the list"""
    next: NotRequired[str | None]
    """cursor of the following page; null on the last one"""

class DeletedDocument(TypedDict):
    """Everything that was deleted, the requested item first."""

    deleted: list[ItemDocument]
    """all items, the requested one first"""

class DisturbanceExperimentDocument(TypedDict):
    """Disturbances of one record."""

    name: str
    """name of the record"""
    disturbances: list[DisturbanceDocument]
    """disturbance at each place"""

class DisturbanceDocument(TypedDict):
    """An estimated disturbance with its 95 % band, in `unit`; null where the filter diverged."""

    place: str
    """input or output with a load, or state that noise moves"""
    kind: Literal["load", "plant"]
    """a load, or a state of the plant itself"""
    unit: str
    """unit of all values"""
    samples: int
    """times before the reduction"""
    times: list[float]
    """times, s"""
    values: list[float | None]
    """estimate from the whole record"""
    lower: list[float | None]
    """lower end of the band"""
    upper: list[float | None]
    """upper end of the band"""

class DisturbancesDocument(TypedDict):
    """Estimated disturbances of a run with noise inside the plant; without it there are no records."""

    id: str
    """identifier of the run"""
    experiments: list[DisturbanceExperimentDocument]
    """records of the run"""

class DriftDocument(TypedDict):
    """Difference between an estimate and a reference."""

    kind: Literal["run", "trend"]
    """against the reference run, or against the prediction of its job's trend"""
    expected: float
    """value of the reference, in the quantity's unit"""
    difference: float
    """estimate minus reference, in the quantity's unit"""
    z: float
    """in standard errors of the difference"""
    limit: float
    """magnitude of z beyond which the estimate is flagged as drifted"""
    drifted: bool
    """whether |z| exceeds the limit"""

class EquationDocument(TypedDict):
    """An equation as a reader writes it."""

    text: str
    """the equation as text, such as `dx/dt = (u - x)/T`"""
    mathml: str
    """the same as a `<math>` element, which a browser shows"""

class ErrorReferenceDocument(TypedDict):
    """Reference values for the errors of the runs with these axis values."""

    cell: dict[str, Any]
    """axis values of these runs"""
    kind: Literal["truth", "estimate"] | None
    """origin of the values"""
    run: str | None
    """run of the estimate; null for the truth"""
    sigma: float | None
    """noise level of that run"""
    parameters: dict[str, float]
    """reference values by name, in their units"""
    note: str
    """why there are none, or what they mean"""

class EstimateDocument(TypedDict):
    """One parameter's estimate."""

    name: str
    """name of the parameter, or of an initial state such as `x(0)`"""
    unit: str
    """unit of its values"""
    value: float | None
    """estimate, in `unit`"""
    lower: float | None
    """lower bound of the search, in `unit`"""
    upper: float | None
    """upper bound of the search, in `unit`"""
    stderr: float | None
    """standard error, in `unit`. If there is none, `reason` says why"""
    interval95: list[float | None] | None
    """both ends of the 95 % interval, in `unit`"""
    status: Literal[
        "identified",
        "not settled",
        "refuted",
        "dependent",
        "ambiguous",
        "group",
        "at bound",
        "unidentifiable",
        "fixed",
        "tied",
        "unfinished",
    ]
    """identified, or why the value is not to be relied on"""
    reason: str
    """reason of the status, or of a missing standard error; empty if there is nothing to say"""
    open_ends: list[Literal["lower", "upper"]]
    """ends of the interval up to which the data speak for any value; there it ends at the bound"""

class ExperimentDocument(TypedDict):
    """Measured and simulated outputs of one experiment."""

    name: str
    """name of the record"""
    measured: list[SeriesDocument]
    """measured outputs"""
    simulated: list[SeriesDocument]
    """simulated outputs"""

class ExportedDataDocument(TypedDict):
    """Sampling of the data."""

    sample_time: float | None
    """sampling period, s; null if irregular"""
    hold: dict[str, str]
    """how each input was read between its samples"""

class ExportedModelDocument(TypedDict):
    """Identified model, from which it can be built and simulated again."""

    format: str
    """name and version of this format"""
    lagid: str | None
    """version of lagid that wrote it"""
    model: dict[str, Any]
    """model document"""
    values: list[IdentifiedValueDocument]
    """parameters and initial states"""
    covariance: CovarianceDocument | None
    """covariance of the free parameters"""
    data: ExportedDataDocument
    """sampling of the data"""
    provenance: dict[str, Any]
    """run, job and data of the values"""

class FaultDocument(TypedDict):
    """One fault of a request."""

    pointer: str
    """JSON pointer into the body; `?name`: in the query; `{name}`: in the path"""
    detail: str
    """what was wrong, what was found, and what would be right"""
    column: NotRequired[int | None]
    """column inside the text of the field, from 1; for equations"""
    option: NotRequired[str | None]
    """option that the detail advises at its end, such as `segments`; for files"""

class FigureDocument(TypedDict):
    """A figure of Plotly."""

    data: list[dict[str, Any]]
    """traces, as Plotly defines them"""
    layout: dict[str, Any]
    """layout, as Plotly defines it"""

class FindingDocument(TypedDict):
    """One explanation of what is left of the data, or one property of the estimate."""

    explanation: str
    """its name, such as `change of a parameter`"""
    family: Literal[
        "constancy",
        "clocks",
        "sensor",
        "actuator",
        "variance",
        "input",
        "reading",
        "start",
        "history",
        "structure",
        "noise",
        "search",
        "identifiability",
        "validation",
        "record",
        "numerics",
    ]
    """what is explained otherwise: the sensor, the clocks, the structure of the model, and so on"""
    severity: Literal["note", "caution", "serious"]
    """serious: no estimate can be relied on. Caution: those of `parameters` cannot, or not without the condition. Note: worth knowing, and moves nothing"""
    brief: str
    """A few words, as they follow “trustworthy, but” or “not trustworthy:”"""
    text: str
    """whole sentences: what was found"""
    advice: str
    """what helps; a setting where there is one. Empty if nothing does"""
    gain: float | None
    """how much lower Schwarz's criterion is with the explanation: twice the logarithm of the odds. null where no likelihood is compared"""
    moves: list[MoveDocument]
    """what each parameter would be, the furthest move first"""
    parameters: list[str]
    """parameters that it makes doubtful; those that a note is about"""
    status: Literal[
        "identified",
        "not settled",
        "refuted",
        "dependent",
        "ambiguous",
        "group",
        "at bound",
        "unidentifiable",
        "fixed",
        "tied",
        "unfinished",
    ]
    """status that these have then"""
    reason: str
    """why, as it follows the status of a parameter that has no move"""
    channels: list[str]
    """channels of the recording that it is about"""
    spans: list[list[float | None]]
    """where in the recording it is, from a time to a time (s); none if it is everywhere"""

class FitPercentDocument(TypedDict):
    """Fit, 100 (1 - ‖y - ŷ‖ / ‖y - ȳ‖) %."""

    estimation: float | None
    """fit to the estimation data, %; not a number for a constant output"""
    validation: float | None
    """fit to the validation data, %; none without them"""

class FreeRunDocument(TypedDict):
    """Measured and simulated outputs, and their agreement."""

    id: str
    """identifier of the run"""
    dataset: str
    """identifier of the dataset"""
    unit: str
    """unit of the RMS"""
    rms: float
    """RMS error, in `unit`"""
    fit_percent: float | None
    """fit, %"""
    agreement: list[AgreementDocument]
    """agreement of each output of each record"""
    starts: dict[str, float]
    """initial states that were estimated on the recording, in their units"""
    experiments: list[ExperimentDocument]
    """measured and simulated outputs"""

class GroupDocument(TypedDict):
    """Summary of the runs with the same values of the grouping keys."""

    key: dict[str, Any]
    """values of the grouping axes and labels"""
    runs: int
    """runs of the group"""
    succeeded: int
    """runs that succeeded"""
    failed: int
    """runs that failed"""
    success_rate: float
    """fraction of finished runs that gave a valid model"""
    sigma: NotRequired[float | None]
    """of the added noise, if all runs have the same"""
    evaluations: float | None
    """mean"""
    seconds: float | None
    """mean compute time"""
    rms: list[float] | None
    """quantiles, in the output's unit"""
    rms_noise_free: NotRequired[list[float] | None]
    """quantiles of the RMS against the records without added noise"""
    rms_cramer_rao_bound: NotRequired[float | None]
    """RMS of estimates at the Cramér–Rao bound: σ√(r/n)"""
    fit_percent: dict[str, list[float] | None]
    """quantiles of the fit, %, by data"""
    parameters: list[ParameterSummaryDocument]
    """summary of each parameter"""

class HealthDocument(TypedDict):
    """The web process answers."""

    status: NotRequired[Literal["ok"]]
    """always ok: else there is no answer"""

class HistoryDocument(TypedDict):
    """Improvements of every island; `names` are those of the columns of `parameters`."""

    id: str
    """identifier of the run"""
    names: list[str]
    """free parameters, in the order of `parameters`"""
    islands: list[list[ImprovementDocument]]
    """improvements of each island, in order"""

class IdentifiabilityDocument(TypedDict):
    """What the data can tell apart, by the sensitivities at the estimate."""

    condition: float | None
    """condition of the scaled sensitivities; none without standard errors"""
    groups: list[IdentifiableCombinationDocument]
    """combinations of parameters that are determined, while these are not each"""
    singular_values: list[float | None]
    """singular values of the scaled sensitivities"""

class IdentifiableCombinationDocument(TypedDict):
    """A combination that the data determine, though not each of its parameters."""

    members: list[str]
    """names of the parameters of the combination"""
    expression: str
    """A product of powers, such as `A_m*k_b/J`, or else a sum, such as `T + L`"""
    value: float | None
    """estimate of the combination; its unit follows from its parameters"""
    stderr: float | None
    """standard error of `value`, in the same unit"""
    is_local: bool
    """whether the combination holds near the estimate only, as a sum in place of `K*exp(-E/300)`"""

class IdentifiedValueDocument(TypedDict):
    """Value of one parameter or initial state, estimated or given."""

    name: str
    """name of the parameter, or of the initial state as `x(0)`"""
    value: float | None
    """value, in `unit`"""
    unit: str
    """unit of value and standard error"""
    stderr: float | None
    """standard error, in `unit`; none without one"""
    status: str
    """status of the estimate; empty if the value was given"""

class ImprovementDocument(TypedDict):
    """A better champion of one island."""

    generation: int
    """generation of the island"""
    evaluations: int
    """simulations of the island so far"""
    rms: float
    """RMS error, in the unit of the run's `rms`"""
    phase: str
    """part of the search that found it"""
    parameters: list[float]
    """values in the order of `names`, in their units"""

class InputHoldDocument(TypedDict):
    """How an input is read between its samples."""

    input: str
    """input of the model"""
    chosen: Literal["zero", "first", "band-limited", "mean", "mean-after"]
    """how it was read"""
    reason: str | None
    """reason of a choice by the values; none if the hold was given"""
    other: Literal["zero", "first", "band-limited", "mean", "mean-after"] | None
    """the reading that was not chosen; none if the hold was given or has no effect"""
    estimates_other: dict[str, float | None] | None
    """estimates of the free parameters with the other reading, from the estimates by least squares, in their units; none if they were not computed"""
    rms_other: float | None
    """RMS error with the other reading, in the unit of the result's `rms`"""

class IslandInDocument(TypedDict):
    """Settings in which one island differs."""

    method: NotRequired[Literal["simple", "improved-paper", "improved"] | None]
    """method of this island"""
    bits: NotRequired[int | None]
    """bits of each parameter in the chromosome"""
    mutation: NotRequired[list[list[int | float]] | None]
    """pairs of a generation and, from it on, the probability of one flipped bit in a child"""

class IslandSummaryDocument(TypedDict):
    """Champion of one island before and after refinement (for the waterfall plot)."""

    champion_rms: float | None
    """RMS error of the search, in the unit of the result's `rms`"""
    refined_rms: float | None
    """RMS error after least squares, in the same unit; none without"""
    parameters: list[float | None]
    """values of the free parameters, in their units"""
    evaluations: int
    """simulations of the island"""

class ItemDocument(TypedDict):
    """A stored item: its kind, its identifier (of a reference its name), and its name."""

    kind: Literal["job", "run", "dataset", "model", "reference"]
    """kind of the item"""
    id: str
    """identifier; of a reference its name"""
    name: str
    """name of the item"""

class JobInDocument(TypedDict):
    """Job: model, data, and how to identify."""

    name: NotRequired[str | None]
    """name of the job; by default model and dataset"""
    model: Any
    """name of a model, `name@version`, or a whole model document"""
    channels: NotRequired[dict[str, str]]
    """recorded channel of each signal of the model; equal names need no entry"""
    hold: NotRequired[
        dict[str, Literal["auto", "zero", "first", "band-limited", "mean", "mean-after"]]
    ]
    """how each input is read between its samples; of which period an output is a mean"""
    parameters: NotRequired[dict[str, ParameterInDocument]]
    """changes of the model's parameters by name"""
    prediction: NotRequired[Literal["simulation", "one-step"]]
    """what is compared with the outputs: a free run from the model's own past, or predictions one step ahead from the measured past"""
    loss: NotRequired[LossInDocument]
    """loss function"""
    weights: NotRequired[dict[str, float | list[float]] | None]
    """weight of each output, one number or one for each experiment. null: 1 for one output, else 1 / its standard deviation; then the noise of each output in each experiment is estimated"""
    skip: NotRequired[int]
    """first samples of each output that are not scored"""
    initial: NotRequired[Literal["rest", "free", "measured", "auto"] | None]
    """where the states start: at rest under the first inputs, at estimated or at measured values. auto compares them by the data. null: as the model's document says"""
    commands: NotRequired[list[str] | None]
    """inputs that a controller computes from the outputs. They are read held, and noise inside the plant is looked for. null: the data tell. Empty: there is no controller"""
    algorithm: NotRequired[AlgorithmInDocument]
    """settings of the search"""
    priority: NotRequired[int]
    """jobs of higher priority come first"""
    reuse: NotRequired[bool]
    """take over results of earlier runs with the same specification"""
    keep_signals: NotRequired[bool | None]
    """store the fitted signals of every run. By default a sweep computes them again when they are asked for"""
    datasets: list[str]
    """datasets by name or id, fitted together as several experiments"""
    validation: NotRequired[ValidationInDocument | None]
    """data that are compared, but not fitted"""
    noise: NotRequired[PlacedNoiseInDocument]
    """noise that is added before fitting"""
    seed: NotRequired[int]
    """seed of the search; the same seed gives the same result, bit for bit"""
    sweep: NotRequired[SweepInDocument]
    """fields that change from run to run"""
    warm_start: NotRequired[str | None]
    """where runs begin: `previous`, a run, or `reference:` and a name"""
    trend: NotRequired[TrendInDocument | None]
    """trend of the estimates over a label"""
    posterior: NotRequired[bool]
    """sample the posterior distribution of the free parameters"""
    compare_orders: NotRequired[bool | None]
    """fit a process with dead time with one order more and one less, too; null: in a job without a sweep"""

class JobDocument(TypedDict):
    """A job and its state."""

    id: str
    """identifier, `job_…`"""
    name: str
    """name of the job"""
    state: Literal["queued", "running", "succeeded", "failed", "cancelled", "incomplete"]
    """state of the job; `incomplete`: it has ended, and some of its runs have failed"""
    cancel_requested: NotRequired[bool]
    """whether it was asked to stop, and has not yet"""
    created_at: str
    """time of the submission, UTC"""
    started_at: NotRequired[str | None]
    """time of the first start, UTC"""
    finished_at: NotRequired[str | None]
    """time of the end, UTC"""
    seconds: NotRequired[float | None]
    """wall time from the first start to the end, or to now; null while queued"""
    attempt: int
    """number of starts, resumptions included"""
    error: NotRequired[str | None]
    """why the job failed; null if it did not"""
    model: str
    """name of the model"""
    note: NotRequired[str | None]
    """note of a user"""
    tags: NotRequired[list[str]]
    """tags of users"""
    version: str
    """version of the program that computed the job, or took it"""
    fingerprint: NotRequired[str | None]
    """digest of the kernels' program: equal ones give results equal bit for bit"""
    spec_hash: str
    """digest of the request"""
    priority: int
    """jobs of higher priority come first"""
    progress: ProgressDocument
    """progress of its runs"""
    rms_unit: NotRequired[str | None]
    """unit of the best RMS; σ for several weighted outputs"""
    outcome: NotRequired[OutcomeDocument | None]
    """outcome so far; null without a result, and of a batch, whose runs see different recordings"""
    request: NotRequired[JobInDocument | None]
    """the request with every default; null in lists"""

class JobPageDocument(TypedDict):
    """Jobs, latest first."""

    items: list[JobDocument]
    """items of this page, in the order of the list"""
    next: NotRequired[str | None]
    """cursor of the following page; null on the last one"""

class KnownBeforeDocument(TypedDict):
    """Time before the start of each record for which its inputs are recorded."""

    estimation: list[float | None]
    """of each estimation record, s"""
    validation: list[float | None]
    """of each validation record, s"""

class LawDocument(TypedDict):
    """Fitted law."""

    law: Literal["line", "power"]
    """kind of the law"""
    formula: str
    """formula with its values"""
    is_chosen: bool
    """whether it has the smaller AICc"""
    coefficients: list[CoefficientDocument]
    """coefficients of the formula"""
    chi_squared: float
    """weighted sum of squares χ²"""
    degrees: int
    """degrees of freedom ν"""
    birge: float
    """Birge ratio √(χ²/ν). If above 1, errors are multiplied by it"""
    aic: float
    """Akaike's information criterion"""
    aicc: float | None
    """null with too few points"""

class LawPointDocument(TypedDict):
    """Value of a law at one x with its 95 % interval."""

    x: float
    """value of the label"""
    value: float | None
    """value of the law, in the quantity's unit"""
    stderr: float | None
    """standard error, in the quantity's unit"""
    lower: float | None
    """lower end of the 95 % interval, in the quantity's unit"""
    upper: float | None
    """upper end of the 95 % interval, in the quantity's unit"""
    is_outside: bool
    """whether x is outside the measured range"""

class LimitsDocument(TypedDict):
    """Limits of a project; null where there is none."""

    max_open_jobs: int
    """most jobs that wait or run"""
    max_open_runs: int
    """most runs of these jobs that have not ended"""
    max_stored_bytes: int | None
    """most bytes of recordings and results"""
    max_daily_evaluations: int | None
    """most simulations of the last 24 hours, of jobs that ran and of requests"""

class LineageEdgeDocument(TypedDict):
    """`child` was made from `parent`."""

    parent: str
    """identifier of the source"""
    child: str
    """identifier of what was made from it"""
    relation: str
    """how it was made"""

class LineageDocument(TypedDict):
    """Everything that a dataset was made from, and everything made from it."""

    id: str
    """identifier of the dataset"""
    edges: list[LineageEdgeDocument]
    """all steps to it and from it"""
    deleted: NotRequired[list[TombstoneDocument]]
    """items that were deleted since"""

class LossInDocument(TypedDict):
    """Loss function: squares, or soft-l1 with a scale in the output's unit."""

    kind: NotRequired[Literal["squares", "soft-l1"]]
    """what is minimised; `soft-l1` limits the influence of outliers"""
    scale: NotRequired[float]
    """residual beyond which `soft-l1` grows linearly, in the output's unit"""
    noise_model: NotRequired[Literal["auto", "white", "ar1", "plant", "load", "drift"]]
    """noise model of the estimates"""

class MarginsDocument(TypedDict):
    """Stability and margins of the loop without limits and with exact dead times."""

    is_stable: bool
    """whether the loop is stable"""
    gain_margin: float | None
    """gain margin, a factor"""
    phase_margin: float | None
    """phase margin, degrees"""
    delay_margin: float | None
    """delay margin, s"""
    crossover_frequency: float | None
    """crossover frequency, rad/s"""
    sensitivity_peak: float | None
    """largest sensitivity (M_s)"""

class MigrantDocument(TypedDict):
    """One line of the migration log."""

    epoch: int
    """number of the migration, from 0"""
    source: int
    """island that sent it, from 0"""
    destination: int
    """island that received it, from 0"""
    fitness: float
    """fitness of the individual; smaller is better"""

class MigrationInDocument(TypedDict):
    """Exchange between islands."""

    every: NotRequired[int]
    """generations between two migrations"""
    topology: NotRequired[Literal["one-way-ring", "ring", "fully-connected", "star", "unconnected"]]
    """which islands send to which"""
    migrants: NotRequired[int]
    """individuals that each island sends"""

class MigrationsDocument(TypedDict):
    """The migration log of a run."""

    id: str
    """identifier of the run"""
    migrants: list[MigrantDocument]
    """migrants in order"""

class MinimumDocument(TypedDict):
    """A minimum of the loss."""

    parameters: dict[str, float | None]
    """values of the free parameters, in their units"""
    rms: float | None
    """RMS error, in the unit of the result's `rms`"""
    count: int
    """how many least-squares fits ended in it, in the search and after it"""
    independent: int
    """how many of them began at random points"""
    likelihood_ratio: float | None
    """n ln(Σe²/Σe²₀) to the best minimum, twice the logarithm of the ratio of likelihoods, made smaller for coloured residuals"""
    is_compatible: bool
    """whether the data do not rule it out"""
    recorded_from: float | None
    """compared from this time of each record on, s, where the input is recorded; none: all of it"""

class ModelDocumentDocument(TypedDict):
    """A model document; its fields are explained in the documentation of models."""

    name: NotRequired[str | None]
    """name of the model"""
    title: NotRequired[str | None]
    """what it describes, in a few words"""

class ModelDocument(TypedDict):
    """A model: built in (`version` 0) or stored by a user."""

    name: str
    """name of the model"""
    version: int
    """version, from 1; 0 for a built-in model"""
    builtin: bool
    """whether it belongs to lagid"""
    title: str
    """what it describes, in a few words"""
    form: str
    """form of the equations"""
    inputs: dict[str, str]
    """unit of each input"""
    outputs: dict[str, str]
    """unit of each output"""
    parameters: dict[str, ModelParameterDocument]
    """parameters by name"""
    note: NotRequired[str | None]
    """note of a user"""
    tags: NotRequired[list[str]]
    """tags of users"""
    document: NotRequired[ModelDocumentDocument | None]
    """document of the model; null in lists"""
    equations: NotRequired[list[EquationDocument]]
    """equations, intermediate names, outputs; empty in lists"""

class ModelPageDocument(TypedDict):
    """Models: on the first page the built-in ones, then those of users."""

    items: list[ModelDocument]
    """items of this page, in the order of the list"""
    next: NotRequired[str | None]
    """cursor of the following page; null on the last one"""

class ModelParameterDocument(TypedDict):
    """Parameter of a model."""

    lower: float | None
    """lower bound, in `unit`; null: follows the data"""
    upper: float | None
    """upper bound, in `unit`; null: follows the data"""
    bounds: NotRequired[str | None]
    """what its bounds follow from"""
    unit: str
    """unit of its values"""
    scale: str
    """scale on which the search moves"""
    fixed: NotRequired[float | None]
    """value at which it is held, in `unit`"""
    tied: NotRequired[str | None]
    """expression that gives its value"""
    physical: NotRequired[str | None]
    """bounds that are limits of the quantity: lower, upper or both"""

class MoveDocument(TypedDict):
    """What a parameter would be under an explanation."""

    parameter: str
    """name of the parameter"""
    value: float | None
    """what it would be, in its unit"""
    stderr: float | None
    """its standard error there, in its unit; none if unknown"""
    stderrs: float | None
    """how far that is from the estimate, in standard errors of the estimate"""

class NoiseSourceDocument(TypedDict):
    """A source of noise, and its size."""

    place: str
    """the output, input or state where it acts"""
    kind: Literal["sensor", "plant", "load"]
    """white noise of a sensor, diffusion of a state, or a slow load"""
    deviation: float | None
    """standard deviation, in `unit`; of a diffusion that after one second"""
    unit: str
    """its unit"""
    correlation_time: float | None
    """correlation time of a load, s"""

class OnsetDelayDocument(TypedDict):
    """Onset delay of one output behind one input in one experiment."""

    experiment: int
    """record, from 0"""
    input: str
    """input of the model"""
    output: str
    """output of the model"""
    delay: float | None
    """median over the events, s; if there is none, `reason` says why"""
    spread: float | None
    """standard deviation over the events, s; none with fewer than two"""
    events: int
    """number of clear events among those examined"""
    threshold: float | None
    """largest share of the excursion at which the output counted as moving"""
    reason: str
    """why there is no delay; empty with one"""
    unit: str
    """unit of delay and spread: s"""

class OrderComparisonDocument(TypedDict):
    """The model's order, one order less and one more, fitted to the same samples."""

    model: str
    """the catalogue's name of the model's own order"""
    preferred_model: str | None
    """the one order that is open; none if there are several"""
    delay: str
    """the model's parameter that is the dead time"""
    unit: str
    """unit of the dead times"""
    delay_range: list[float | None]
    """smallest and largest dead time of the open orders, in `unit`"""
    noise_model: Literal["white", "ar1", "plant", "load", "drift"]
    """noise model of the criteria"""
    fits: list[OrderFitDocument]
    """the orders, the lowest first"""

class OrderFitDocument(TypedDict):
    """A process of one order, fitted to the samples of an identification."""

    model: str
    """its name in the catalogue"""
    order: int
    """number of poles"""
    delay: float | None
    """dead time, in the comparison's `unit`"""
    delay_stderr: float | None
    """standard error of the dead time, in the same unit"""
    values: dict[str, float | None]
    """all parameters of that model, in their units"""
    rms: float | None
    """RMS error, in the unit of the result's `rms`"""
    bic: float | None
    """criterion of Schwarz, smaller is better; with the noise model of the comparison"""
    is_open: bool
    """whether its BIC is within 6 of the lowest: no strong evidence against it"""
    leaves_noise: bool
    """whether it tells all its parameters and leaves nothing but noise. Only of the preferred order this is looked for"""

class OutcomeDocument(TypedDict):
    """Outcome of a job: that of its only run, or of the best one by RMS."""

    run: str
    """identifier of the run"""
    cell: dict[str, Any]
    """values of the sweep's axes, by their pointers"""
    labels: dict[str, float | int | str | bool | None]
    """labels of the cell, such as a length"""
    fit_estimation: float | None
    """fit to the estimation data, %"""
    fit_validation: float | None
    """fit to the validation data, %; null without them"""
    trust: Literal["trustworthy", "limited", "not trustworthy"]
    """limited: the estimates hold under the condition that the verdict names"""
    verdict: str
    """the verdict in words"""
    warnings: int
    """number of its warnings, notes included"""

class ParameterInDocument(TypedDict):
    """Changes of one parameter of the model."""

    lower: NotRequired[float | None]
    """lower bound, in the parameter's unit"""
    upper: NotRequired[float | None]
    """upper bound, in the parameter's unit"""
    scale: NotRequired[Literal["linear", "log"] | None]
    """scale on which the search moves"""
    fixed: NotRequired[float | None]
    """value at which the parameter is held, in its unit"""
    tied: NotRequired[str | None]
    """expression of other parameters that gives the value"""
    physical: NotRequired[Literal["lower", "upper", "both"] | None]
    """bounds that are limits of the quantity itself"""

class ParameterSummaryDocument(TypedDict):
    """Summary of one parameter over the runs of a group, in its unit."""

    name: str
    """name of the parameter"""
    unit: str
    """unit of its values"""
    value: list[float]
    """quantiles of the estimates"""
    stderr: float | None
    """median standard error: the Cramér–Rao bound where runs reach the optimum"""
    reference: NotRequired[float | None]
    """value that errors refer to"""
    error: NotRequired[list[float] | None]
    """quantiles of estimate minus reference"""
    cramer_rao_bound: NotRequired[float | None]
    """least standard deviation under the added noise"""

class PlacedNoiseInDocument(TypedDict):
    """Noise added before fitting: to the measured outputs, or inside the plant."""

    sigma: NotRequired[float]
    """standard deviation of the noise, in the unit of each output"""
    seed: NotRequired[int]
    """seed of the noise; the same seed gives the same noise"""
    place: NotRequired[Literal["sensor", "plant"]]
    """`plant`: φ of Eq. 13 and 16, where the model's document says that noise enters. The record is simulated again with it. Then `sigma` is that of each sample of a recursion, or else per √s, in the unit of the state"""
    parameters: NotRequired[dict[str, float]]
    """true values of the simulation with noise inside the plant, by name"""

class PlantNoiseDocument(TypedDict):
    """Noise inside the plant, and errors from one sample ahead to the free run."""

    sources: list[NoiseSourceDocument]
    """the sensors, then the noise inside the plant"""
    rms_free: float | None
    """RMS error of the free run with the same estimates, in the unit of the result's `rms`; none if it diverges"""
    fit_free: float | None
    """its fit, %"""
    prediction_errors: list[PredictionErrorDocument]
    """RMS errors of predictions 1, 2, 5, 10, … samples ahead, up to a tenth of the shortest record"""

class PointDocument(TypedDict):
    """Estimate of one quantity at one label."""

    x: float
    """value of the label"""
    value: float | None
    """estimate, in the quantity's unit; null without one"""
    stderr: float | None
    """standard error, in the quantity's unit"""
    runs: list[str]
    """identifiers of the runs at this label"""
    status: str
    """status of the estimate"""
    is_used: bool
    """whether the laws are fitted to it; an outlier leaves them by default"""
    studentised: NotRequired[float | None]
    """deleted residual"""
    p_value: NotRequired[float | None]
    """Bonferroni-corrected p-value of the outlier test"""
    is_outlier: NotRequired[bool]
    """whether the outlier test flags it"""
    drifts: NotRequired[list[DriftDocument]]
    """differences from references"""

class PosteriorDocument(TypedDict):
    """Samples of the posterior, or the reason why there are none."""

    parameters: list[PosteriorParameterDocument]
    """the free parameters; empty without samples"""
    samples: NotRequired[list[list[float | None]]]
    """at most 1,000 of the samples, chosen at random, in the parameters' units; not in lists"""
    correlation: CorrelationMatrixDocument
    """correlation of the samples"""
    walkers: int
    """walkers of the chain"""
    steps: int
    """steps of each walker, with those that are left out"""
    acceptance: float | None
    """share of the proposed moves that were accepted"""
    evaluations: int
    """simulations of the chain"""
    converged: bool
    """whether the chain has converged"""
    reason: str
    """why the chain has not converged, or why there is none; empty if it has"""
    gain: float | None
    """likelihood ratio of the best sample to the estimate; 0 if none is better"""

class PosteriorParameterDocument(TypedDict):
    """Posterior distribution of one parameter."""

    name: str
    """name of the parameter"""
    unit: str
    """unit of its values"""
    median: float | None
    """median, in `unit`"""
    interval95: list[float | None]
    """the 2.5 and 97.5 % quantiles, in `unit`"""
    effective_samples: float | None
    """number of independent samples that would estimate the mean as well"""

class PredictionErrorDocument(TypedDict):
    """Error of predictions so many samples ahead."""

    samples: int
    """samples ahead"""
    time: float | None
    """mean time ahead, s"""
    rms: float | None
    """RMS error, in the unit of the result's `rms`; none if a prediction diverged"""

class ProfileDocument(TypedDict):
    """Profile likelihood of one parameter."""

    name: str
    """name of the parameter"""
    unit: str
    """unit of its values"""
    estimate: float
    """estimate of the run"""
    interval95: list[float | None]
    """95 % interval by the likelihood ratio; an end is null if it is not reached"""
    values: list[float]
    """values of the parameter, in its unit"""
    ratio: list[float | None]
    """likelihood ratio n ln(S(v)/S₀) at each value"""
    rms: list[float | None]
    """RMS error at each value, in the unit of the run's `rms`"""
    others: dict[str, list[float]]
    """the other free parameters at each value, in their units"""
    evaluations: int
    """simulations of this profile"""

class ProfilesDocument(TypedDict):
    """Profiles of a run, and their figure as Plotly JSON."""

    id: str
    """identifier of the run"""
    threshold: float
    """likelihood ratio at the ends of the intervals"""
    profiles: list[ProfileDocument]
    """profile of each parameter"""
    figure: FigureDocument
    """figure of the profiles, as Plotly JSON"""

class ProgressDocument(TypedDict):
    """Progress of a job."""

    runs: int
    """runs of the job"""
    finished: int
    """runs that have ended, failed ones included"""
    failed: int
    """runs that failed"""
    reused: NotRequired[int]
    """runs taken over from earlier runs"""
    best_rms: NotRequired[float | None]
    """of the best run. Not comparable between runs on other data or noise"""
    evaluations: NotRequired[int]
    """simulations so far, over all runs"""
    generation: NotRequired[int]
    """generations so far of the run that is furthest"""
    seconds_left: NotRequired[float | None]
    """estimated time to the end, s; null if unknown"""

class QuantityDocument(TypedDict):
    """Trend of a parameter or an onset delay over x."""

    name: str
    """name of the parameter or delay"""
    unit: str
    """unit of the estimates"""
    kind: Literal["parameter", "onset delay"]
    """kind of the quantity"""
    points: list[PointDocument]
    """estimate at each label"""
    between_runs: float | None
    """scatter of runs of one label, in stated errors. Null without such runs"""
    laws: list[LawDocument]
    """fitted laws"""
    reason: NotRequired[str]
    """why there is no law"""
    band: NotRequired[list[LawPointDocument]]
    """confidence band of the chosen law"""
    predictions: NotRequired[list[LawPointDocument]]
    """with intervals for a new estimate"""
    notes: NotRequired[list[str]]
    """what limits the trend"""

class ReadyDocument(TypedDict):
    """Every part of the service works."""

    database: NotRequired[Literal["ok"]]
    """its tables are of this version"""
    store: NotRequired[Literal["ok"]]
    """objects can be written"""
    dispatcher: NotRequired[Literal["ok"]]
    """at least one claims jobs"""

class ReferenceDocument(TypedDict):
    """Reference: the run in use, its estimates, and earlier acceptances."""

    name: str
    """name of the reference"""
    run: str
    """id of the run in use"""
    job: str
    """id of its job"""
    by: NotRequired[str | None]
    """who accepted it"""
    note: NotRequired[str | None]
    """why it was accepted"""
    at: str
    """time of the acceptance, UTC"""
    tags: NotRequired[list[str]]
    """tags of users"""
    labels: NotRequired[dict[str, float | int | str | bool | None]]
    """labels of the run"""
    estimates: NotRequired[dict[str, ReferenceValueDocument]]
    """estimates by parameter, each in the parameter's unit"""
    history: NotRequired[list[AcceptanceDocument]]
    """the previous acceptances (at most 1,000), latest first"""

class ReferencePageDocument(TypedDict):
    """References in use, by name."""

    items: list[ReferenceDocument]
    """items of this page, in the order of the list"""
    next: NotRequired[str | None]
    """cursor of the following page; null on the last one"""

class ReferenceValueDocument(TypedDict):
    """Estimate of one parameter of a reference."""

    value: float | None
    """estimate, in the parameter's unit"""
    stderr: float | None
    """standard error, in the parameter's unit"""

class ResidualTestDocument(TypedDict):
    """One test of one output's residuals."""

    experiment: int
    """record, from 0"""
    output: str
    """output whose residuals are tested"""
    test: Literal["whiteness", "independence"]
    """whiteness: with their own past. Independence: with an input"""
    input: str | None
    """input of the test; none for whiteness"""
    outcome: Literal["passed", "failed", "not tested"]
    """outcome of the test"""
    samples: int
    """scored residuals of the test"""
    lags_tested: int
    """lags of the statistic"""
    inside95: float | None
    """share of the tested lags within the 95 % band"""
    inside99: float | None
    """share of the tested lags within the 99 % band"""
    statistic: float | None
    """test statistic, χ² distributed if the model is true"""
    degrees: float | None
    """degrees of freedom of the statistic"""
    p: float | None
    """probability of a larger statistic if the model is true"""
    reason: str
    """why it was not tested, or what failed"""

class ResidualTestsDocument(TypedDict):
    """All tests of a result."""

    data: Literal["estimation", "validation"]
    """data of the residuals"""
    passed: bool | None
    """whether all tests passed; none if nothing could be tested"""
    tests: list[ResidualTestDocument]
    """each test"""
    level: float | None
    """probability that a true model fails at least one of its tests"""

class ResidualsDocument(TypedDict):
    """Tests of a run's residuals with their correlation functions."""

    id: str
    """identifier of the run"""
    data: Literal["estimation", "validation"]
    """data of the residuals"""
    passed: bool | None
    """whether all tests passed; null if nothing could be tested"""
    level: float
    """probability that a true model fails at least one test"""
    note: str
    """what could not be read; empty if nothing"""
    tests: list[CorrelationDocument]
    """tests with their correlation functions"""

class ResponseDocument(TypedDict):
    """Measured against simulated, experiment by experiment."""

    id: str
    """identifier of the run"""
    experiments: list[ExperimentDocument]
    """records of the run"""

class RunDocument(TypedDict):
    """One identification: its cell of the sweep, progress, and result."""

    id: str
    """identifier, `run_…`"""
    job: str
    """identifier of its job"""
    number: int
    """number in the job, from 0"""
    cell: dict[str, Any]
    """values of the sweep's axes, by their pointers"""
    labels: dict[str, float | int | str | bool | None]
    """labels of the cell, such as a length"""
    state: Literal["queued", "running", "succeeded", "failed", "cancelled"]
    """state of the run"""
    progress: float
    """share that is done, from 0 to 1"""
    error: NotRequired[str | None]
    """why the run failed; null if it did not"""
    reused_from: NotRequired[str | None]
    """the earlier run with the same specification"""
    seed: NotRequired[int | None]
    """seed of the search"""
    spec_hash: NotRequired[str | None]
    """digest of all that the result depends on"""
    version: NotRequired[str | None]
    """version of the program that computed the result"""
    fingerprint: NotRequired[str | None]
    """digest of the kernels' program: equal ones give results equal bit for bit"""
    note: NotRequired[str | None]
    """note of a user"""
    tags: NotRequired[list[str]]
    """tags of users"""
    created_at: str
    """time when the run was made, UTC"""
    started_at: NotRequired[str | None]
    """time of the start, UTC"""
    finished_at: NotRequired[str | None]
    """time of the end, UTC"""
    has_signals: NotRequired[bool]
    """whether its fitted signals can be read"""
    rms_unit: NotRequired[str | None]
    """given for a single run; σ for several weighted outputs"""
    rms: NotRequired[float | None]
    """RMS error so far, in the output's unit, or in σ if weighted"""
    evaluations: NotRequired[int]
    """simulations so far"""
    generations: NotRequired[int]
    """generations so far"""
    seconds: NotRequired[float | None]
    """compute time, s"""
    rms_noise_free: NotRequired[float | None]
    """RMS error against the record without added noise, in the unit of `rms`"""
    valid: NotRequired[bool | None]
    """whether the RMS error is below the safe limit"""
    parameters: NotRequired[list[EstimateDocument]]
    """estimates with their errors"""
    rms_validation: NotRequired[float | None]
    """RMS error on the validation data, in the unit of `rms`; none without them"""
    fit_percent: NotRequired[FitPercentDocument | None]
    """fit to both kinds of data, %"""
    agreement: NotRequired[AgreementsDocument | None]
    """agreement of each output of each record"""
    islands: NotRequired[list[IslandSummaryDocument] | None]
    """champion of each island"""
    identifiability: NotRequired[IdentifiabilityDocument | None]
    """what the data can tell apart"""
    criteria: NotRequired[CriteriaDocument | None]
    """information criteria"""
    correlation: NotRequired[CorrelationMatrixDocument | None]
    """correlation of the estimates; none without errors"""
    noise_sd: NotRequired[float | None]
    """standard deviation of the weighted residuals, in the unit of `rms`"""
    noise_colour: NotRequired[
        Literal["white", "first-order", "coloured", "drifting", "clustered"] | None
    ]
    """colour of the residuals that the errors assume. If they drift over the whole record, the errors are lower bounds"""
    noise_model: NotRequired[Literal["white", "ar1", "plant", "load", "drift"] | None]
    """noise model of the estimates"""
    correlation_times: NotRequired[dict[str, float | None] | None]
    """correlation time of each output's noise, s, where the noise model has one"""
    noise_deviations: NotRequired[list[list[float | None]] | None]
    """relative deviation of the noise by experiment and output, by which residuals were divided; none if all count alike or weights were given"""
    residual_tests: NotRequired[ResidualTestsDocument | None]
    """tests of the residuals"""
    onset_delays: NotRequired[list[OnsetDelayDocument] | None]
    """delay between the start of an input's and an output's change"""
    time_unit: NotRequired[str | None]
    """unit in which the record had its times, such as `min`. Estimates are in their own unit"""
    data_bounds: NotRequired[list[str] | None]
    """parameters whose bounds follow the data, unless given"""
    input_hold: NotRequired[list[InputHoldDocument] | None]
    """how each input is read between its samples, and the estimates if it were read otherwise"""
    commands: NotRequired[list[str] | None]
    """inputs that a controller computes, as the request or the data say. They are read held"""
    known_before: NotRequired[KnownBeforeDocument | None]
    """recorded time before the start of each record, s"""
    search: NotRequired[SearchEvidenceDocument | None]
    """whether the search settled, and the minima that were found"""
    posterior: NotRequired[PosteriorDocument | None]
    """samples of the posterior; none if not requested"""
    order_comparison: NotRequired[OrderComparisonDocument | None]
    """one order less and one more; none if not compared, or no process with dead time"""
    delays: NotRequired[list[str] | None]
    """free parameters that time lags depend on"""
    findings: NotRequired[list[FindingDocument]]
    """what explains the residuals, and what speaks against the estimates; the most severe first"""
    explained: NotRequired[bool | None]
    """whether explanations of the residuals were looked for. In a sweep they are not, until a run is opened"""
    verdict: NotRequired[VerdictDocument | None]
    """whether the estimates can be relied on"""
    warnings: NotRequired[list[str]]
    """the sentences of the findings"""
    substeps: NotRequired[int | None]
    """integration steps in one grid step: the model's, or more"""
    selection: NotRequired[list[SelectedTermDocument] | None]
    """selected terms; empty if none were to be selected"""
    initial: NotRequired[Literal["rest", "free", "measured"] | None]
    """start of the states that the estimates assume; none: as the model's document says"""
    plant_noise: NotRequired[PlantNoiseDocument | None]
    """sizes of the noise, and the free run, if noise acts inside the plant. Then `rms`, fits and signals are those of predictions one sample ahead"""

class RunPageDocument(TypedDict):
    """Runs of a job."""

    items: list[RunDocument]
    """items of this page, in the order of the list"""
    next: NotRequired[str | None]
    """cursor of the following page; null on the last one"""

class RunSimulationDocument(TypedDict):
    """Simulated signals of a run's model, reduced so that extremes stay visible."""

    id: str
    """identifier of the run"""
    parameters: dict[str, float]
    """values of the parameters, in their units"""
    outputs: list[SeriesDocument]
    """simulated outputs"""
    inputs: list[SeriesDocument]
    """inputs of the model"""
    reference: NotRequired[SeriesDocument | None]
    """reference of the loop"""
    command: NotRequired[SeriesDocument | None]
    """command of the controller"""
    metrics: NotRequired[StepMetricsDocument | None]
    """metrics of the step response"""
    controller: NotRequired[ControllerDocument | None]
    """controller that was used"""
    tuning: NotRequired[TuningDocument | None]
    """process and source of the tuning rule"""
    margins: NotRequired[MarginsDocument | None]
    """stability of the loop"""
    notes: NotRequired[list[str]]
    """what was assumed"""
    dataset: NotRequired[DatasetDocument | None]
    """stored result; null if it was not stored"""

class SearchEvidenceDocument(TypedDict):
    """What a result knows of the whole search."""

    settled: bool
    """whether the search settled"""
    because: Literal["starts", "residuals"] | None
    """what shows it; none if nothing does"""
    independent_starts: int
    """local searches from random points"""
    agreeing_starts: int
    """how many of them ended in the best minimum"""
    minima: list[MinimumDocument]
    """minima in which least squares ended after the search, the lowest first"""

class SegmentDocument(TypedDict):
    """Part of a recording that is identified as a separate experiment."""

    start: float
    """time of its start, s"""
    stop: float
    """time of its end, s"""
    origin: float | None
    """time that its own time 0 is, s"""
    labels: dict[str, float | int | str | bool | None]
    """values of the label columns"""

class SelectedTermDocument(TypedDict):
    """A term in the order of selection."""

    term: str
    """the term"""
    err: float | None
    """error-reduction ratio: the share of the output's sum of squares that this term explains in addition to the terms before it"""
    cumulated: float | None
    """share explained with all terms so far"""
    coefficient: float | None
    """coefficient in the model of all selected terms, before the search. It comes from one-step least squares, or from the free run if that selected the terms. Its unit follows from the term"""
    probability: float | None
    """probability that the term belongs to the model: the weight of the selections with it"""
    coverage: float | None
    """probability that the 95 % interval of the coefficient holds, over all these selections"""
    rival: str
    """the likeliest other selection: the change in words. Empty if term and coefficient are certain"""

class SequenceInDocument(TypedDict):
    """The sequence search."""

    kind: NotRequired[Literal["paper", "adaptive"]]
    """fixed steps (Eq. 11, 12 of the paper), or least squares over a growing record"""
    beta: NotRequired[float]
    """first step, as a share of the value or of the range"""
    relative: NotRequired[bool]
    """whether steps are relative to the value (Eq. 12 of the paper), else to the range"""

class SeriesDocument(TypedDict):
    """One line of a plot, with at most the requested number of points."""

    name: str
    """name of the signal"""
    unit: str
    """unit of the values"""
    times: list[float]
    """times, s"""
    values: list[float | None]
    """values, in `unit`; null where there is none"""
    samples: int
    """samples before the reduction"""

class SignalsDocument(TypedDict):
    """Channels of a dataset, reduced so that extremes stay visible."""

    id: str
    """identifier of the dataset"""
    channels: list[SeriesDocument]
    """samples of each channel"""
    history: NotRequired[list[SeriesDocument]]
    """samples from before the start of the record"""

class SpanDocument(TypedDict):
    """Range of the measured values of an output."""

    output: str
    """output of the model"""
    channel: str
    """recorded channel"""
    unit: str
    """unit of the range"""
    lower: float
    """least measured value, in `unit`"""
    upper: float
    """largest measured value, in `unit`"""

class StepMetricsDocument(TypedDict):
    """Metrics of a step response; null where the event never happens."""

    output: str
    """controlled output"""
    unit: str
    """unit of the output"""
    rise_time: float | None
    """time from 10 to 90 % of the change, s"""
    overshoot_percent: float | None
    """overshoot over the reference, %"""
    overshoot_of_final_percent: float | None
    """overshoot over the final value, %"""
    settling_time: float | None
    """time when the output last enters the band, s"""
    band: float
    """half width of the band, in `unit`"""
    steady_error: float | None
    """reference minus final value, in `unit`"""
    final_value: float | None
    """mean of the last tenth of the record, in `unit`"""
    runs_away: NotRequired[bool]
    """whether the output leaves the reference further and further behind"""
    is_settled: NotRequired[bool]
    """whether the output stays in the band to the end"""
    iae: NotRequired[float | None]
    """integral of |e|, in `unit` times s"""
    itae: NotRequired[float | None]
    """integral of t |e|, in `unit` times s²"""
    swing: NotRequired[float | None]
    """sustained oscillation, peak to peak, in `unit`"""
    swing_period: NotRequired[float | None]
    """period of that oscillation, s"""

class StopInDocument(TypedDict):
    """End conditions in addition to the generations."""

    evaluations: NotRequired[int | None]
    """most simulations, never exceeded, of search, refinement, nearby minima, noise model, standard errors, orders and posterior. At least one population. An individual whose fitness is known counts too; checks of the finished estimate do not"""
    seconds: NotRequired[float | None]
    """most computing time, s. Least squares may end a tenth later (0.2 to 10 s), and a warning lists what was left out. The result then depends on the machine"""
    rms: NotRequired[float | None]
    """RMS error at which the search stops, in the output's unit"""
    settled: NotRequired[int | None]
    """restarts that must end at the best individual, and two more, and a third of all. null: never stop for them"""

class SubtractedDocument(TypedDict):
    """What `detrend` subtracted from a channel: `value` + `slope`·(t − `time`)."""

    channel: str
    """name of the channel at that step"""
    unit: str
    """unit of the value; `slope` is in this unit per second"""
    time: float
    """time of the first sample, s"""
    value: float
    """value at that time: the mean, or the start of the line"""
    slope: float
    """slope of the line; 0 for a mean"""

class SummaryDocument(TypedDict):
    """Aggregates over the runs of a job."""

    job: str
    """identifier of the job"""
    by: list[str]
    """grouping axes and labels"""
    quantiles: list[float]
    """probabilities of all quantiles"""
    groups: list[GroupDocument]
    """summary of each group"""
    runs: NotRequired[int]
    """runs of the job"""
    reused: NotRequired[int]
    """runs taken over from earlier runs"""
    rms_unit: NotRequired[str | None]
    """unit of each RMS; σ for several weighted outputs"""
    references: NotRequired[list[ErrorReferenceDocument]]
    """reference values of the errors"""
    notes: NotRequired[list[str]]
    """what the numbers mean"""

class SweepAxisInDocument(TypedDict):
    """One axis of a sweep: the field it changes and its values."""

    path: str
    """JSON pointer to the field of the job that changes"""
    values: NotRequired[list[Any] | None]
    """values of the field"""
    range: NotRequired[list[int] | None]
    """whole numbers: start, stop[, step], without stop"""
    log: NotRequired[list[float | int] | None]
    """start, stop and count of values with equal ratios"""
    zip: NotRequired[str | None]
    """axes of this name step together"""
    labels: NotRequired[list[dict[str, float | str]] | None]
    """labels of each value, such as a length"""

class SweepInDocument(TypedDict):
    """Sweep: the crossed axes give one run per cell."""

    axes: NotRequired[list[SweepAxisInDocument]]
    """axes, which are crossed"""

class TombstoneDocument(TypedDict):
    """What is left of a deleted item."""

    id: str
    """identifier of the item"""
    name: str
    """name that it had"""
    deleted_at: str | None
    """time of its deletion, UTC"""

class TrendInDocument(TypedDict):
    """Trend of parameters over a label."""

    x: str
    """name of the label that is the abscissa"""
    parameters: NotRequired[list[str]]
    """parameters to analyse; empty: all free ones"""
    predict: NotRequired[list[float]]
    """values of x to predict at, in the label's unit"""
    reference: NotRequired[str | None]
    """run to compare the batch with: `run_…`, or `reference:` and a name"""

class TrendDocument(TypedDict):
    """Trend of a job's batch over one of its labels."""

    job: str
    """identifier of the job"""
    x: str
    """name of the label"""
    outliers: Literal["exclude", "include"]
    """whether the laws leave outliers out"""
    reference: NotRequired[str | None]
    """run that the batch is compared with"""
    reference_x: NotRequired[float | None]
    """label of the reference; null if it has none"""
    reference_names: NotRequired[list[str]]
    """names under which it was accepted"""
    labels: list[BatchLabelDocument]
    """runs of each label, in the order of x"""
    quantities: list[QuantityDocument]
    """trend of each quantity"""
    missing: NotRequired[int]
    """runs without a result"""
    failed: NotRequired[int]
    """how many of these failed"""
    unended: NotRequired[int]
    """how many of these have not ended"""
    notes: NotRequired[list[str]]
    """what limits the trends"""

class TuningDocument(TypedDict):
    """Process that a tuning rule used, and the rule's source."""

    rule: str
    """tuning rule"""
    controller: str
    """kind of the controller"""
    closed_loop_time_constant: float | None
    """time constant of the closed loop (τ_c), s"""
    process_gain: float
    """gain of the process; per s if it integrates"""
    process_delay: float
    """dead time of the process, s"""
    process_time_constant: float | None
    """time constant of the process, s; null if it integrates"""
    process_second_time_constant: float
    """second time constant of the process, s"""
    formulas: list[str]
    """formulas of the rule with their values"""
    reference: str
    """where the rule was published"""

class UseDocument(TypedDict):
    """What a project uses of its limits."""

    open_jobs: int
    """jobs that wait or run"""
    open_runs: int
    """runs of these jobs that have not ended"""
    stored_bytes: int
    """bytes of recordings, and of results at 8.4 kB a run"""
    daily_evaluations: int
    """simulations of the last 24 hours, of jobs that ran and of requests"""

class ValidationInDocument(TypedDict):
    """Validation data: other datasets, or the last fraction of each record."""

    datasets: NotRequired[list[str] | None]
    """datasets that are compared, but not fitted"""
    fraction: NotRequired[float | None]
    """last part of each record that is compared, but not fitted"""

class VerdictDocument(TypedDict):
    """Whether the estimates of a result can be relied on."""

    trust: Literal["trustworthy", "limited", "not trustworthy"]
    """limited: the estimates hold but for those that the text names, or under its condition"""
    text: str
    """the verdict in words, such as “trustworthy but for L: L changes at about 98 s”"""
