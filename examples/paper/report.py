"""Write the study as one HTML file that needs no server and no network."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape
from string import Template

from plotly.io import to_html
from plotly.offline import get_plotlyjs

from examples.paper.document import Plot, ReportTable, Section, describe_check

TITLE = "The paper's tables and figures, and ours"
_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
body { max-width: 84rem; margin: 1rem auto; padding: 0 1rem; color: #303a44;
  font: 14px/1.45 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
table { border-collapse: collapse; display: block; overflow-x: auto; margin: 1rem 0; }
caption { text-align: left; font-weight: 600; white-space: nowrap; }
th, td { padding: .2rem .6rem; border-bottom: 1px solid #dde2e6; white-space: nowrap; }
th { text-align: left; font-weight: 500; }
td, thead th:not(:first-child) { text-align: right; font-variant-numeric: tabular-nums; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(36rem, 100%), 1fr)); }
figure { margin: .5rem; } small, figcaption { color: #5c6873; }
</style>
<script>$plotly</script>
</head>
<body>
<h1>$title</h1>
<p><small>$made</small></p>
<p>T. Asakura and Q. Guo, <i>Identification of nonlinear time lag systems by improved genetic
algorithm and its application to explosion-proof pneumatic robots</i>. Every number and line of ours
comes from a job of a lagid service. <b>simple</b> is the paper's simple genetic algorithm.
<b>improved-paper</b> is its sequence search, taken literally. <b>improved</b> is lagid's default
method. The paper's own figures are described in the captions, not copied.</p>
<ol>$contents</ol>
$sections
</body>
</html>
""")


def render_report(sections: Sequence[Section], *, quick: bool) -> str:
    """Write the report: tables, figures with captions, and checks."""
    made = f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC" + (", quick" if quick else "")
    numbered = list(enumerate(sections, 1))
    return _PAGE.substitute(
        title=TITLE,
        plotly=get_plotlyjs(),
        made=made,
        contents="".join(f'<li><a href="#section-{n}">{escape(s.title)}</a>' for n, s in numbered),
        sections="\n".join(_render_section(section, n) for n, section in numbered),
    )


def _render_section(section: Section, number: int) -> str:
    blocks = [f'<h2 id="section-{number}">{escape(section.title)}</h2>']
    blocks += [f"<p>{_to_html(section.text)}</p>", *map(_render_table, section.tables)]
    checks = [f"<li><b>{describe_check(c)}</b>: {_to_html(c.text)}" for c in section.checks]
    jobs = f"<p><small>jobs: {', '.join(section.jobs)}</small></p>" if section.jobs else ""
    plots = [_render_plot(p, f"figure-{number}-{n}") for n, p in enumerate(section.plots, 1)]
    blocks += ["<ul>", *checks, "</ul>", jobs, '<div class="plots">', *plots, "</div>"]
    return "\n".join(blocks)


def _render_table(table: ReportTable) -> str:
    headings = "".join(f"<th>{escape(heading)}</th>" for heading in table.headings)
    rows = "\n".join(
        f"<tr><th>{escape(row[0])}</th>{''.join(f'<td>{escape(cell)}</td>' for cell in row[1:])}"
        for row in table.rows
    )
    return (
        f"<table><caption>{escape(table.title)}</caption>\n<thead><tr>{headings}</thead>\n"
        f"<tbody>{rows}</tbody></table>\n<p><small>{_to_html(table.note)}</small></p>"
    )


def _render_plot(plot: Plot, identifier: str) -> str:
    figure = to_html(plot.figure, full_html=False, include_plotlyjs=False, div_id=identifier)
    caption = f"<figcaption>{_to_html(plot.caption)}</figcaption>"
    return f"<figure><h3>{escape(plot.title)}</h3>{figure}{caption}</figure>"


def _to_html(text: str) -> str:
    return re.sub("`(.+?)`", r"<code>\1</code>", escape(text, quote=False))
