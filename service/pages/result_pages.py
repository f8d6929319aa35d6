"""Results across jobs: one parameter of the runs of any jobs, as a table, a figure and CSV."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from urllib.parse import urlencode

from sqlalchemy.orm import Session

from service.core.label_text import format_labels, name_label, write_csv
from service.figures.estimates_figure import ResultPoint, plot_results
from service.jobs.job_links import find_model_name
from service.pages.render import render_template
from service.pages.views import format_cell
from service.repositories.result_rows import ResultRow, list_results
from service.repositories.search_conditions import ListFilter
from service.storage.statements import RowPage
from sysid.core.text import find_shown_error
from sysid.core.value_documents import encode
from sysid.figures.plotly import Figure, empty_figure
from sysid.uncertainty.estimates import Estimate

_Entry = tuple[ResultRow, Estimate]
"""A run, and what its result says of one parameter."""

RUNS_PER_PAGE, RUNS_OF_A_FILE = 100, 1000
ORDER, DATE = "order", "date"
"""What is always offered as the abscissa; other names are those of labels and axes."""
FIELDS = (
    ("parameter", "Parameter", ""),
    ("over", "Over", ""),
    ("runs", "Runs", ""),
    ("name", "Job name", "part of it"),
    ("model", "Model", ""),
    ("recording", "Recording", "id or name"),
    ("tag", "Tag", ""),
    ("label", "Label", "length_m=5"),
    ("since", "Since", ""),
    ("until", "Until", ""),
)
"""Fields of the form: name, label and hint."""
COLUMNS = [
    "job",
    "run",
    "number",
    "name",
    "model",
    "labels",
    "parameter",
    "value",
    "stderr",
    "lower95",
    "upper95",
    "unit",
    "status",
    "fit_percent",
    "finished_at",
]
"""Columns of the file."""


@dataclass(frozen=True, slots=True)
class ResultChoice:
    """What is shown of which runs.

    Attributes
    ----------
    parameter : str
        Its name; empty: the one that most runs have.
    over : str
        Abscissa of the figure: the order of the runs, their date, a label, or an axis of a sweep.
    only_best : bool
        Whether the best run stands for each job.
    form : mapping of str to str
        The filled fields as the user typed them.
    """

    chosen: ListFilter
    parameter: str
    over: str
    only_best: bool
    form: Mapping[str, str]
    cursor: str | None


@dataclass(frozen=True, slots=True)
class ListedResult:
    """One row of the table."""

    row: ResultRow
    model: str
    place: str
    estimate: Estimate


def results_page(session: Session, choice: ResultChoice) -> str:
    """Render one parameter over the runs of any jobs."""
    page = _list_page(session, choice, RUNS_PER_PAGE)
    parameter, entries = _choose_parameter(page.items, choice.parameter)
    # Other pages, the figure and the file show what this page chose.
    query = {**choice.form, **({"parameter": parameter} if parameter else {})}
    listed = [
        ListedResult(row, find_model_name(row.job.spec), _describe_place(row), estimate)
        for row, estimate in entries
    ]
    return render_template(
        "results.html",
        rows=listed,
        parameter=parameter,
        n_others=len(page.items) - len(listed),
        form=choice.form,
        fields=FIELDS,
        choices=_list_choices(page.items, parameter, choice),
        query=urlencode({**query, **({"cursor": choice.cursor} if choice.cursor else {})}),
        first_query=urlencode(choice.form),
        cursor=choice.cursor,
        next=urlencode({**query, "cursor": page.next}) if page.next else "",
    )


def load_results_figure(session: Session, choice: ResultChoice) -> Figure:
    """Draw the parameter of the page over the order of the runs, their date or a label."""
    page = _list_page(session, choice, RUNS_PER_PAGE)
    parameter, entries = _choose_parameter(page.items, choice.parameter)
    if not entries:
        return empty_figure()
    unit = Counter(one.unit for _, one in entries).most_common(1)[0][0]
    same = _put_oldest_first([(row, one) for row, one in entries if one.unit == unit])
    points = [
        ResultPoint(
            x=x,
            value=one.value,
            stderr=find_shown_error(one.stderr, one.status),
            group=find_model_name(row.job.spec),
            text=f"{row.job.name}, run {row.number + 1}",
        )
        for place, (row, one) in enumerate(same, 1)
        if (x := _find_abscissa(row, place, choice.over)) is not None
    ]
    return plot_results(points, parameter, unit, _name_abscissa(choice.over), choice.over == DATE)


def write_results_csv(session: Session, choice: ResultChoice) -> str:
    """Write the parameter of the page as CSV, from this page on, and of more runs."""
    page = _list_page(session, choice, RUNS_OF_A_FILE)
    _, entries = _choose_parameter(page.items, choice.parameter)
    return write_csv([COLUMNS, *(encode(_list_fields(row, one)) for row, one in entries)])


def _list_fields(row: ResultRow, one: Estimate) -> tuple[object, ...]:
    """List the fields of a line of the file, in the order of `COLUMNS`."""
    stderr = find_shown_error(one.stderr, one.status)
    low, high = (None if stderr is None else one.interval95) or (None, None)
    return (
        row.job.id,
        row.run,
        row.number,
        row.job.name,
        find_model_name(row.job.spec),
        _describe_place(row),
        one.name,
        one.value,
        stderr,
        low,
        high,
        one.unit,
        one.status,
        row.fit_estimation,
        row.finished_at,
    )


def _list_page(session: Session, choice: ResultChoice, limit: int) -> RowPage[ResultRow]:
    return list_results(
        session,
        cursor=choice.cursor,
        limit=limit,
        chosen=choice.chosen,
        only_best=choice.only_best,
    )


def _put_oldest_first(entries: Sequence[_Entry]) -> list[_Entry]:
    """Put the latest job last. The runs of a job stay in their order."""
    places = {row.job.id: place for place, (row, _) in enumerate(entries)}
    return sorted(entries, key=lambda entry: -places[entry[0].job.id])


def _choose_parameter(rows: Sequence[ResultRow], wanted: str) -> tuple[str, list[_Entry]]:
    """Choose the wanted parameter, or the most frequent one, and its entry of each run."""
    name = wanted or next(iter(_count_parameters(rows)), "")
    entries: list[_Entry] = [
        (row, one) for row in rows for one in row.estimates if one.name == name and one.is_free
    ]
    return name, entries


def _count_parameters(rows: Iterable[ResultRow]) -> list[str]:
    """List the names of the free parameters, the most frequent first."""
    names = (one.name for row in rows for one in row.estimates if one.is_free)
    return [name for name, _ in Counter(names).most_common()]


def _list_choices(
    rows: Sequence[ResultRow], parameter: str, choice: ResultChoice
) -> dict[str, list[tuple[str, str]]]:
    names = dict.fromkeys([*_count_parameters(rows), *filter(None, [parameter])])
    overs = dict.fromkeys(name for row in rows for name in _list_abscissae(row))
    if choice.over not in (ORDER, DATE):
        overs.setdefault(choice.over)
    return {
        "parameter": [(name, name) for name in names] or [("", "none yet")],
        "over": [("", "the order of the runs"), (DATE, "date")]
        + [(name, name_label(name.rpartition("/")[2])) for name in overs],
        "runs": [("", "all"), ("best", "the best of each job")],
    }


def _list_abscissae(row: ResultRow) -> Iterator[str]:
    """List the labels and axes of a run whose values are numbers."""
    for name, value in (*row.labels.items(), *row.cell.items()):
        if isinstance(value, int | float) and not isinstance(value, bool):
            yield name


def _find_abscissa(row: ResultRow, place: int, over: str) -> float | str | None:
    if over == ORDER:
        return place
    if over == DATE:
        return row.finished_at.isoformat() if row.finished_at else None
    value = row.labels.get(over, row.cell.get(over))
    return value if isinstance(value, int | float) else None


def _name_abscissa(over: str) -> str:
    if over == ORDER:
        return "run, the oldest first"
    return "end of the run" if over == DATE else name_label(over.rpartition("/")[2])


def _describe_place(row: ResultRow) -> str:
    if row.cell:
        return format_cell(row.cell, row.labels)
    return format_labels(row.labels) if row.labels else ""
