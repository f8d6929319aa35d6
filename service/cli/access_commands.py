"""`lagid key …`, `lagid project …` and `lagid audit`: they work on the database itself."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.common import (
    AsJson,
    Limit,
    err,
    fail_usage,
    fetch_listing,
    print_json,
    print_line,
    print_listing,
    print_table,
    show_examples,
)
from service.cli.server_processes import DataDir, load_settings, open_database
from service.core.bodies.text_checks import MANY

if TYPE_CHECKING:
    from service.storage.sessions import Database
    from service.storage.tables import ApiKey, AuditEntry
    from service.storage.tables import Project as ProjectRow

DEFAULT_PROJECT_NAME = "default"
MAX_NAME_CHARACTERS = 100
ACTOR = "command line"
NO_LIMIT = "none"
"""What removes a limit."""

key_app = typer.Typer(help="Create, list and revoke API keys.", no_args_is_help=True)
project_app = typer.Typer(help="Create projects and set their limits.", no_args_is_help=True)

Project = Annotated[str, typer.Option("--project", "-p", help="Project, by name or identifier.")]
AnyProject = Annotated[
    str | None,
    typer.Option(
        "--project", "-p", help="Only this project, by name or identifier.", show_default=False
    ),
]
ProjectName = Annotated[str, typer.Argument(help="Project, by name or identifier.")]
LimitText = Annotated[
    str | None, typer.Option(help="A number, or none for the default.", show_default=False)
]


@contextmanager
def _open_projects(data_dir: Any) -> Iterator["Database"]:
    """Open the database for changes by whoever runs the command; create the tables if needed."""
    settings = load_settings(data_dir=data_dir)
    from service.storage import migrate
    from service.storage.sessions import SessionOwner

    settings.prepare_data_folder()
    with open_database(settings) as database:
        migrate.upgrade_database(database)
        yield database.open_for(SessionOwner(actor=ACTOR))


@key_app.command(
    "create",
    epilog=show_examples(
        "lagid key create laptop",
        "lagid key create dashboard --scope read --days 90 --project tubes",
    ),
)
def create_key(
    name: Annotated[str, typer.Argument(help="Who or what uses the key.")],
    project: Project = DEFAULT_PROJECT_NAME,
    scope: Annotated[
        str, typer.Option(help="read, write or admin; each one includes those before it.")
    ] = "write",
    days: Annotated[
        int | None, typer.Option(help="Days until it ends (default: never).", show_default=False)
    ] = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Create an API key and print it, this once: only a digest of it is stored."""
    with _open_projects(data_dir) as database:
        from service.access import keys
        from service.access.scopes import SCOPES
        from service.core.errors import InvalidRequest
        from service.repositories.project_rows import ProjectRepository

        chosen = next((known for known in SCOPES if known == scope), None)
        if chosen is None:
            fail_usage(f"--scope {scope}: need {', '.join(SCOPES)}")
        try:
            with database.write_session() as session:
                owner = ProjectRepository(session).get(project)
                created = keys.create_key(session, owner.id, name, chosen, days)
        except InvalidRequest as error:
            fail_usage(str(error).lstrip("/"))
        if as_json:
            print_json({**_describe_key(created.row, owner.name), "key": created.token})
        else:
            err.print(
                f"key {created.row.id} of project {owner.name}, scope {scope}. Copy it now: only "
                "a digest is stored.",
                markup=False,
            )
            print_line(created.token)


@key_app.command("list", epilog=show_examples("lagid key list", "lagid key list --project tubes"))
def list_keys(
    project: AnyProject = None, data_dir: DataDir = None, as_json: AsJson = False
) -> None:
    """List the keys with their state and last use."""
    with _open_projects(data_dir) as database:
        from service.repositories.key_rows import KeyRepository, list_project_names
        from service.repositories.project_rows import ProjectRepository

        with database.read_session() as session:
            chosen = None if project is None else ProjectRepository(session).get(project).id
            names = list_project_names(session)
            keys = [
                _describe_key(row, names[row.project_id])
                for row in KeyRepository(session, chosen).list_all()
            ]
    if as_json:
        print_json(keys)
    else:
        columns = ("id", "name", "project", "scope", "state", "created", "last_used", "expires")
        print_table(
            [column.replace("_", " ") for column in columns],
            ([key[column] for column in columns] for key in keys),
            empty="there is no key",
        )


@key_app.command("revoke", epilog=show_examples("lagid key revoke key_01"))
def revoke_key(
    key: Annotated[str, typer.Argument(help="Identifier of the key: key_…")],
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """End a key at once, and the sessions of browsers that signed in with it."""
    with _open_projects(data_dir) as database:
        from service.repositories.key_rows import KeyRepository, list_project_names

        with database.write_session() as session:
            row = KeyRepository(session, None).revoke(key)
            described = _describe_key(row, list_project_names(session)[row.project_id])
    if as_json:
        print_json(described)
    else:
        print_line(f"{row.id} ({row.name}) is revoked")


@project_app.command(
    "create",
    epilog=show_examples("lagid project create tubes"),
)
def create_project(
    name: Annotated[str, typer.Argument(help="Name of the project.")],
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Create a project; its keys see nothing of others."""
    if not name.strip() or not name.isprintable() or len(name) > MAX_NAME_CHARACTERS:
        fail_usage(f"{name!r:.120} is no name; need 1 to {MAX_NAME_CHARACTERS} characters")
    with _open_projects(data_dir) as database:
        from service.repositories.project_rows import ProjectRepository

        with database.write_session() as session:
            project = ProjectRepository(session).add(name.strip())
        _print_project(project, as_json)


@project_app.command(
    "limit",
    epilog=show_examples(
        "lagid project limit tubes --max-stored-bytes 10000000000",
        "lagid project limit tubes --max-daily-evaluations none",
    ),
)
def limit_project(
    project: ProjectName,
    max_open_jobs: LimitText = None,
    max_open_runs: LimitText = None,
    max_stored_bytes: LimitText = None,
    max_daily_evaluations: LimitText = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Set limits of a project; those without an option stay."""
    limits = _read_limits(max_open_jobs, max_open_runs, max_stored_bytes, max_daily_evaluations)
    if not limits:
        fail_usage("name a limit, such as --max-stored-bytes 10000000000")
    with _open_projects(data_dir) as database:
        from service.repositories.project_rows import ProjectRepository

        with database.write_session() as session:
            row = ProjectRepository(session).change_limits(project, limits)
        _print_project(row, as_json)


@project_app.command("list", epilog=show_examples("lagid project list"))
def list_projects(data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """List the projects with their limits, and what they use."""
    with _open_projects(data_dir) as database:
        from service.repositories.project_rows import ProjectRepository

        with database.read_session() as session:
            repository = ProjectRepository(session)
            projects = [
                {
                    **_describe_project(row),
                    "stored_bytes": (used := repository.measure_use(row.id)).stored_bytes,
                    "daily_evaluations": used.daily_evaluations,
                }
                for row in repository.list_all()
            ]
    if as_json:
        print_json(projects)
    else:
        columns = list(projects[0])
        numbers = [column if column in ("id", "name") else f">{column}" for column in columns]
        print_table(
            [heading.replace("_", " ") for heading in numbers],
            ([project[column] for column in columns] for project in projects),
            empty="there is no project",
        )


def list_audit_log(
    project: AnyProject = None,
    limit: Limit = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """List who did what, the latest first."""
    with _open_projects(data_dir) as database:
        from service.repositories.audit_rows import list_actions
        from service.repositories.project_rows import ProjectRepository

        with database.read_session() as session:
            chosen = None if project is None else ProjectRepository(session).get(project).id
            listing = fetch_listing(
                lambda at_most: [
                    _describe_entry(row)
                    for row in list_actions(session, chosen, limit=at_most or MANY).items
                ],
                limit,
                as_json,
            )
    columns = ("at", "project", "actor", "action", "object_id", "request_id")
    print_listing(
        listing,
        as_json,
        [column.replace("_", " ") for column in columns],
        lambda entry: [entry[column] for column in columns],
        empty="nothing was done yet",
    )


def _read_limits(*texts: str | None) -> dict[str, int | None]:
    from service.repositories.project_rows import LIMIT_NAMES

    limits: dict[str, int | None] = {}
    for name, text in zip(LIMIT_NAMES, texts, strict=True):
        if text is not None and text != NO_LIMIT and not _is_limit(text):
            fail_usage(f"--{name.replace('_', '-')} {text}: need a whole number, or {NO_LIMIT}")
        if text is not None:
            limits[name] = None if text == NO_LIMIT else int(text)
    return limits


def _is_limit(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) <= 18


def _print_project(project: "ProjectRow", as_json: bool) -> None:
    if as_json:
        print_json(_describe_project(project))
        return
    limits = [
        f"{name.replace('_', ' ')} {NO_LIMIT if limit is None else limit}"
        for name, limit in _list_limits(project).items()
    ]
    print_line(f"{project.id}  {project.name}: {', '.join(limits)}")


def _describe_project(project: "ProjectRow") -> dict[str, Any]:
    return {"id": project.id, "name": project.name, **_list_limits(project)}


def _list_limits(project: "ProjectRow") -> dict[str, int | None]:
    from service.repositories.project_rows import LIMIT_NAMES

    return {name: getattr(project, name) for name in LIMIT_NAMES}


def _describe_key(key: "ApiKey", project: str) -> dict[str, Any]:
    from service.access.callers import describe_scopes
    from service.access.keys import describe_state
    from service.storage.columns import utc_now

    return {
        "id": key.id,
        "name": key.name,
        "project": project,
        "scope": describe_scopes(key.scopes),
        "state": describe_state(key, utc_now()),
        "created": _format_time(key.created_at),
        "last_used": _format_time(key.last_used_at),
        "expires": _format_time(key.expires_at),
    }


def _describe_entry(entry: "AuditEntry") -> dict[str, Any]:
    return {
        "id": entry.id,
        "at": _format_time(entry.at),
        "project": entry.project_id,
        "actor": entry.actor,
        "action": entry.action,
        "object_id": entry.object_id,
        "request_id": entry.request_id,
    }


def _format_time(time: datetime | None) -> str | None:
    return None if time is None else time.isoformat(timespec="seconds")
