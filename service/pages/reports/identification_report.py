"""Render an identification of this process as one HTML file, without a job or a database."""

from collections.abc import Mapping
from importlib.metadata import version

import yaml

from service.core.bodies.user_documents import to_finite
from service.figures.embed import templates_json, write_figures
from service.pages.render import (
    draw_script,
    load_stylesheet,
    plotly_script,
    render_template,
    security_policy,
)
from sysid.results.figures import ResultFigures, list_report_figures
from sysid.results.identification import Identification
from sysid.results.result import find_output_unit

MAX_EXPERIMENTS = 4


def render_identification_report(
    found: Identification, title: str, facts: Mapping[str, str], seconds: float, request: str
) -> str:
    """Render the report of a result with its data: tables, figures, model, request.

    Parameters
    ----------
    facts : mapping of str to str
        What else the first section shows, such as the file of the recording.
    request : str
        The request as text.
    """
    assert found.data is not None
    document = yaml.safe_dump(
        dict(found.data.model.document), sort_keys=False, allow_unicode=True, width=100
    )
    return render_template(
        "report_identification.html",
        run={
            "title": title,
            "unit": find_output_unit(found),
            "best_rms": to_finite(found.rms),
            "fit_estimation": found.fit_percent.estimation,
            "fit_validation": found.fit_percent.validation,
            "evaluations": found.evaluations,
            "generations": found.generations,
            "seconds": seconds,
            "error": None,
            "result": found,
            "model": found.data.model,
        },
        facts=list(facts.items()),
        figures=write_figures(
            list_report_figures(ResultFigures(found), MAX_EXPERIMENTS, names_each=False)
        ),
        model=document,
        request=request,
        version=version("lagid"),
        policy=security_policy(),
        style=load_stylesheet(),
        plotly_code=plotly_script(),
        draw=draw_script(),
        templates=templates_json(),
    )
