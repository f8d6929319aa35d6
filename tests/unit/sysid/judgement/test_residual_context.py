"""What explanations start from: where something begins, moves, other inputs, names of samples."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.judgement.judge import explain_residuals
from sysid.judgement.residual_context import ResidualContext, find_delay_parameters, find_held
from sysid.models.catalogue.load import load_model
from sysid.models.parse import parse_model
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate
from sysid.uncertainty.sensitivities import compute_sensitivities
from tests.support.library.judged_records import (
    FAST,
    FINE,
    NOISE,
    STEP,
    TIMES,
    N,
    build_context,
    draw_levels,
    draw_noise,
    draw_record,
    hold,
    make_record,
)
from tests.support.library.small_models import LINE

TWO_OUTPUTS = parse_model(
    LINE | {"name": "two", "outputs": {"y": "a*u(t) + b + x", "z": "a*u(t) - b + x"}}
)


def build_line(*shifts: FloatArray, times: FloatArray | None = None) -> ResidualContext:
    """A line through a noisy record for each shift (n,) of its output."""
    records = []
    for number, shift in enumerate(shifts):
        u = draw_levels(number, shift.size)
        y = 2.0 * u + 1.0 + NOISE * draw_noise(number, n=shift.size) + shift
        records.append(make_record(u, y, times=times))
    return build_context(records, parse_model(LINE), {"a": 2.0, "b": 1.0})


def step_at(position: int, n: int = N, size: float = 0.2) -> FloatArray:
    return np.where(np.arange(n) >= position, size, 0.0)


def find_moments(context: ResidualContext) -> list[tuple[float, str]]:
    column = context.weigh(np.ones(context.times.size))[:, 0]
    return [(moment, where) for moment, _, where in context.find_breaks(column)]


@pytest.mark.parametrize("position", [60, 200, 350])
def test_a_break_is_found_at_its_sample(position: int) -> None:
    moments = find_moments(build_line(step_at(position)))
    assert moments
    assert min(abs(moment - STEP * position) for moment, _ in moments) <= STEP
    assert f"{moments[0][0]:.4g} s" == moments[0][1]


def test_the_late_part_of_a_column_begins_at_the_break_and_ends_with_its_experiment() -> None:
    context = build_line(np.zeros(N), step_at(150), np.zeros(N))
    column = context.weigh(np.arange(3.0 * N) + 1.0)[:, 0]
    for moment, late, where in context.find_breaks(column):
        assert where.endswith(" of experiment 2")
        (rows,) = np.nonzero(late)
        np.testing.assert_array_equal(late[rows], column[rows])
        assert rows[0] == N + round(moment / STEP)
        assert rows[-1] == 2 * N - 1


def test_an_experiment_that_differs_as_a_whole_breaks_at_its_first_sample() -> None:
    moments = find_moments(build_line(np.zeros(N), step_at(0)))
    assert "0 s of experiment 2" in [where for _, where in moments]


def test_no_break_is_looked_for_at_the_edges() -> None:
    for position in (3, N - 3):
        for moment, _ in find_moments(build_line(step_at(position, size=5.0))):
            assert 0.05 * N * STEP <= moment <= 0.95 * N * STEP


def test_a_break_is_found_between_irregular_times() -> None:
    times = np.cumsum(np.random.default_rng(1).uniform(0.1, 1.5, N))
    moments = find_moments(build_line(step_at(170), times=times))
    assert min(abs(moment - times[170]) for moment, _ in moments) <= 1.5


def test_missing_samples_are_left_out() -> None:
    shift = step_at(200)
    shift[50:90] = np.nan
    context = build_line(shift)
    assert context.times.size == N - 40
    assert not np.isin(STEP * np.arange(50, 90), context.times).any()
    assert np.all(np.isfinite(context.measurement))
    (moment, _), *_ = find_moments(context)
    assert moment == pytest.approx(200 * STEP, abs=STEP)


def test_each_output_has_its_rows() -> None:
    records = []
    for seed in (1, 2):
        u = draw_levels(seed)
        outputs = tuple(
            Channel(name, TIMES, 2.0 * u + sign + NOISE * draw_noise(seed + number))
            for number, (name, sign) in enumerate((("y", 1.0), ("z", -1.0)))
        )
        records.append(Record((Channel("u", TIMES, u, hold="zero"),), outputs))
    context = build_context(records, TWO_OUTPUTS, {"a": 2.0, "b": 1.0})
    rows = {name: mask for name, mask, _ in context.iterate_outputs()}
    assert [*rows] == ["y", "z"]
    np.testing.assert_array_equal(rows["y"], ~rows["z"])
    assert rows["y"].sum() == 2 * N
    assert context.measurement[rows["y"]].mean() > context.measurement[rows["z"]].mean()


def test_the_same_inputs_give_the_same_simulation_and_others_their_response() -> None:
    context = build_line(np.zeros(N))
    same = context.simulate(context.problem.records)
    np.testing.assert_array_equal(same, context.simulation)
    higher = context.simulate(context.replace_input("u", lambda values: values + 1.0))
    a = context.theta[context.problem.free_names.index("a")]
    np.testing.assert_allclose(higher - context.simulation, a, rtol=1e-9)
    assert context.simulations.spent >= 2
    assert context.problem.records[0].inputs[0].values.max() <= 2.0  # the own record is as it was


def begin_inputs_earlier(record: Record) -> Record:
    """Let the input move for 20 s before the record."""
    (u,) = record.inputs
    times = np.concatenate([u.times[0] + STEP * np.arange(-40, 0), u.times])
    values = np.concatenate([2.0 - draw_levels(8, 40), u.values])
    return replace(record, inputs=(replace(u, times=times, values=values),))


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda one: one.replace_holds({"y": "mean"}), id="outputs that are means"),
        pytest.param(begin_inputs_earlier, id="inputs that begin earlier"),
    ],
)
def test_records_of_another_form_are_simulated_as_a_problem_that_is_built_of_them(
    change: Callable[[Record], Record],
) -> None:
    context = build_context([draw_record(FAST, 1)], "fopdt", FAST.values, initial="rest")
    records = [change(record) for record in context.problem.records]
    built = Problem.build(load_model("fopdt"), records, initial="rest")
    assert built.free_names == context.problem.free_names
    expected = built.predict(context.theta[None])[0]
    np.testing.assert_allclose(context.simulate(records), expected, rtol=1e-12)
    assert np.max(np.abs(expected - context.simulation)) > NOISE


def compare_moves(shift: FloatArray, pattern: FloatArray) -> None:
    """Compare moves and values with least squares of both columns: a line is linear."""
    context = build_line(shift)
    model = context.residual_model
    moves = context.compute_moves(model.fit(context.weigh(pattern)))
    u, y = draw_levels(0), context.measurement
    before = np.linalg.lstsq(np.column_stack([u, np.ones(N)]), y, rcond=None)[0]
    after = np.linalg.lstsq(np.column_stack([u, np.ones(N), pattern]), y, rcond=None)[0]
    known = {one.name: one for one in context.analysis.estimates}
    assert {move.parameter for move in moves} == {"a", "b"}
    assert abs(moves[0].stderrs) >= abs(moves[1].stderrs)
    for name, old, new in zip("ab", before, after[:2], strict=True):
        (move,) = (move for move in moves if move.parameter == name)
        assert known[name].value == pytest.approx(old, rel=1e-6)
        assert move.value == pytest.approx(new, abs=0.2 * (move.stderr or 0.0))
        assert move.stderrs == pytest.approx((move.value - old) / (known[name].stderr or 0.0))


def test_moves_are_what_least_squares_of_both_columns_changes() -> None:
    pattern = np.random.default_rng(9).standard_normal(N) + 0.5 * draw_levels(0)
    compare_moves(0.05 * pattern, pattern)


def test_the_value_of_a_move_is_that_with_the_explanation_also_beside_coloured_residuals() -> None:
    compare_moves(step_at(230), step_at(230, size=1.0))


def test_a_parameter_that_varies_moves_to_both_of_its_ends() -> None:
    context = build_line(step_at(230))
    model = context.residual_model
    number = context.problem.free_names.index("b")
    fit = model.fit(model.columns[:, [number]] * (step_at(230) > 0)[:, None], 1)
    moves = context.compute_moves(fit, None, (number, 0.0, 1.0))
    values = [move.value for move in moves if move.parameter == "b"]
    assert sorted(values) == pytest.approx([1.0, 1.2], abs=0.02)


def test_an_input_is_read_some_periods_before_and_after_its_jump() -> None:
    context = build_line(np.zeros(N))
    u = draw_levels(0)
    np.testing.assert_array_equal(context.read_input("u"), u)
    np.testing.assert_array_equal(context.read_input("u", 3.0)[3:], u[:-3])
    assert context.inputs == ["u"]
    assert [channel.name for channel in context.moving_inputs] == ["u"]
    still = [replace(context.problem.records[0], inputs=(Channel("u", [0.0, 1e3], [1.0, 1.0]),))]
    rested = build_context(
        still, parse_model(LINE), {"a": 2.0, "b": 1.0}, parameters={"b": {"fixed": 1.0}}
    )
    assert rested.moving_inputs == []


def test_the_largest_innovations_are_the_shocks() -> None:
    shift = np.zeros(N)
    shift[[40, 250]] = 1.0, -2.0
    assert build_line(shift).find_shocks()[:2] == [250, 40]


def test_the_slope_is_that_of_the_simulated_output_within_an_experiment() -> None:
    context = build_context([draw_record(FAST, 1), draw_record(FAST, 2)], "fopdt", FAST.values)
    for part in context.parts:
        values = context.simulation[part.rows]
        expected = np.gradient(values, part.times)
        np.testing.assert_allclose(context.slope[part.rows], expected)


def test_parameters_that_lags_depend_on_are_delays_and_starts_are_not_declared() -> None:
    context = build_context([draw_record(FAST, 1)], "fopdt", FAST.values)
    assert context.delays == {"L"}
    assert [name for _, name in context.parameter_numbers] == ["K", "T", "L", "y0"]
    tied = load_model(
        {
            **load_model("fopdt").document,
            "parameters": {
                **load_model("fopdt").document["parameters"],
                "V": {"lower": 0.9, "upper": 5.0},
            },
            "equations": {"x": "(K*u(t - L/V) - x)/T"},
        }
    )
    problem = build_context([draw_record(FAST, 1)], tied, {**FAST.values, "V": 1.0}).problem
    assert find_delay_parameters(problem) == {"L", "V"}


@pytest.mark.parametrize("has_errors", [True, False])
def test_errors_of_the_integration_are_taken_out_of_records_that_have_them(
    has_errors: bool,
) -> None:
    """One that the model's own steps made has none."""
    added = 0.2 * NOISE * draw_levels(9)
    context = build_line(added if has_errors else np.zeros(N))
    vars(context)["_integration_error"] = context.weigh(added)[:, 0]
    assert context.analysis.residuals_and_sensitivities is not None
    rest = -context.analysis.residuals_and_sensitivities[0]
    wanted = rest - context.weigh(added)[:, 0] if has_errors else rest
    np.testing.assert_array_equal(context.residual_model.residuals, wanted)


def test_moves_on_a_log_scale_keep_the_sign_of_a_value() -> None:
    context = build_context([draw_record(FAST, 1)], "fopdt", FAST.values)
    names = list(context.problem.free_names)
    scaled, plain = names.index("T"), names.index("L")
    value = float(context.theta[scaled])
    assert context.move_value(scaled, -2.0 * value) == pytest.approx(value * np.exp(-2.0))
    assert context.move_value(scaled, 1e-6) == pytest.approx(value + 1e-6)
    assert context.move_value(plain, -0.5) == pytest.approx(float(context.theta[plain]) - 0.5)
    fit = context.residual_model.without
    far = fit.coefficients.copy()
    far[scaled] = -3.0 * fit.errors[scaled]
    (move,) = [
        one for one in context.compute_moves(replace(fit, coefficients=far)) if one.parameter == "T"
    ]
    assert move.stderr is not None
    assert 0.0 < move.value < value
    assert np.log(move.value / value) == pytest.approx(-3.0 * move.stderr / move.value)


def test_slow_changes_of_a_parameter_are_told_inside_its_scale() -> None:
    u = draw_levels(1)
    share = np.linspace(0.0, 1.0, N)
    slow = replace(FAST, times=(12.0,))
    fast, slow_y = (one.respond(hold(u))[::FINE] for one in (replace(FAST, times=(0.6,)), slow))
    y = (1.0 - share) * fast + share * slow_y + NOISE * draw_noise(1)
    context = build_context([make_record(u, y)], "fopdt", FAST.values)
    texts = [one.text for one in explain_residuals(context).findings]
    assert texts
    assert not any("T = -" in text or "about -" in text.partition("T drifts")[2] for text in texts)


def test_a_jump_of_a_state_acts_on_all_outputs_of_its_experiment() -> None:
    records = [
        Record(
            (Channel("u", TIMES, draw_levels(seed)),),
            (Channel("y", TIMES, draw_noise(seed)), Channel("z", TIMES, draw_noise(seed + 9))),
        )
        for seed in (1, 2)
    ]
    context = build_context(records, TWO_OUTPUTS, {"a": 1.0})
    slope = np.exp(-np.tile(TIMES, 4))
    shifted = context.shift_start(slope, 2 * N + 100)  # of y in experiment 2
    late = TIMES - TIMES[100]
    expected = np.where(late >= 0.0, np.exp(-late), 0.0)
    for number, part in enumerate(context.parts):
        wanted = expected if part.experiment == 1 else np.zeros(N)
        np.testing.assert_allclose(shifted[part.rows], wanted, err_msg=str(number))


@pytest.mark.parametrize(("slope", "is_held"), [(2.3, True), (1.7, False)])
def test_a_parameter_that_the_data_push_over_its_bound_stays_there(
    slope: float, is_held: bool
) -> None:
    """Its bound is 2. Where the data pull it inwards again, it has its column."""
    u = draw_levels(0, N)
    document = LINE | {"parameters": LINE["parameters"] | {"a": {"lower": -1.0, "upper": 2.0}}}
    context = build_context(
        [make_record(u, slope * u + 1.0 + NOISE * draw_noise(0))],
        parse_model(document),
        {"a": 2.0, "b": 1.0},
    )
    fit = context.residual_model.without
    moves = {move.parameter for move in context.compute_moves(fit)}
    assert (fit.coefficients[0] == 0.0) == is_held
    assert moves == ({"b"} if is_held else {"a", "b"})


@pytest.mark.parametrize(("true", "is_held"), [(1.5, True), (2.5, False)])
def test_a_bound_holds_a_parameter_only_if_the_data_push_it_over(
    true: float, is_held: bool
) -> None:
    u = draw_levels(1)
    record = make_record(u, true * u + 1.0 + NOISE * draw_noise(1))
    problem = Problem.build(parse_model(LINE), [record], parameters={"a": {"lower": 2.0}})
    theta = np.array([2.0, 1.0])
    slopes = compute_sensitivities(problem, theta)
    held = find_held(problem, theta, -slopes.residuals, slopes.columns)
    assert held.tolist() == [is_held, False]


def test_sizes_of_noise_explain_no_residuals() -> None:
    u, random = draw_levels(3, N), np.random.default_rng(3)
    drift = np.cumsum(0.02 * random.normal(size=N))
    record = make_record(u, 2.0 * u + 1.0 + drift + NOISE * draw_noise(3))
    settings = {"load[y]": {"lower": 0.01, "upper": 0.5}}  # too small: the size is at its bound
    problem = Problem.build(
        parse_model(LINE), [record], loss=Loss(noise_model="drift"), parameters=settings
    )
    start = dict(zip(problem.free_names, [2.0, 1.0, 0.5, 5.0], strict=True))
    (end,) = refine_candidates(problem, [np.array([start[n] for n in problem.free_names])])
    assert end is not None
    context = ResidualContext(problem, end.theta, analyse_estimate(problem, end.theta))
    lengths = np.linalg.norm(context.residual_model.columns, axis=0)
    assert dict(zip(problem.free_names, lengths > 0.0, strict=True)) == {
        "a": True,
        "b": True,
        "load[y]": False,
        "tau[y]": False,
    }
    assert [name for _, name in context.parameter_numbers] == ["a", "b"]
