"""`lagid db keep`: how long a project keeps its ended jobs."""

from typing import Annotated

import typer

from service.cli.access_commands import ACTOR, DEFAULT_PROJECT_NAME, Project
from service.cli.common import (
    AsJson,
    fail_usage,
    out,
    parse_number,
    print_json,
    show_examples,
)
from service.cli.server_processes import (
    DataDir,
    database_app,
    load_settings,
    open_database,
    require_database,
)

MAX_DAYS = 36_500
FOREVER, DEFAULT = "forever", "default"
Days = Annotated[
    str | None,
    typer.Argument(help=f"Days, `{FOREVER}`, or `{DEFAULT}` (LAGID_KEEP_DAYS); none: show them."),
]
app = database_app


@app.command("keep", epilog=show_examples("lagid db keep 365", "lagid db keep forever"))
def keep_jobs(
    days: Days = None,
    project: Project = DEFAULT_PROJECT_NAME,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Show or set how long ended jobs of a project are kept, with what only they use."""
    settings = load_settings(data_dir=data_dir)
    from service.repositories.project_rows import ProjectRepository
    from service.storage import migrate
    from service.storage.sessions import SessionOwner

    require_database(settings)
    with open_database(settings) as database:
        migrate.check_revision(database)
        with database.open_for(SessionOwner(actor=ACTOR)).write_session() as session:
            projects = ProjectRepository(session)
            if days is None:
                row = projects.get(project)
            else:
                row = projects.change_retention(project, _parse_days(days))
            chosen = row.keep_days
            identity = row.id
    effective = settings.keep_days if chosen is None else chosen or None
    if as_json:
        print_json({"project": identity, "keep_days": effective, "is_default": chosen is None})
        return
    rule = "for ever" if effective is None else f"for {effective:g} days"
    source = " (default)" if chosen is None else ""
    out.print(f"{identity} keeps ended jobs {rule}{source}", markup=False)


def _parse_days(text: str) -> float | None:
    """Return the days to store: 0 for ever, None for the default."""
    if text in (FOREVER, DEFAULT):
        return 0.0 if text == FOREVER else None
    days = parse_number("DAYS", text)
    if not 0 < days <= MAX_DAYS:
        fail_usage(f"DAYS: found {text}; need more than 0 and at most {MAX_DAYS}")
    return days
