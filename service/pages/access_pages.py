"""Pages to sign in, and to manage the keys of a project."""

from datetime import UTC, datetime

from sqlalchemy.orm import Session

from service.access.callers import describe_scopes
from service.access.keys import CreatedKey, describe_state
from service.access.scopes import SCOPES
from service.pages.render import render_template
from service.repositories.key_rows import KeyRepository
from service.repositories.project_rows import ProjectRepository


def sign_in_page(target: str, fault: str = "") -> str:
    """Render the form that takes a key; `target` is where the browser goes afterwards."""
    return render_template("sign_in.html", target=target, fault=fault)


def keys_page(
    session: Session, project_id: str, created: CreatedKey | None = None, fault: str = ""
) -> str:
    """Render the keys of a project; a new one is shown with its text, this once."""
    now = datetime.now(UTC)
    rows = [
        {"row": row, "scope": describe_scopes(row.scopes), "state": describe_state(row, now)}
        for row in KeyRepository(session, project_id).list_all()
    ]
    project = ProjectRepository(session).get(project_id)
    return render_template(
        "keys.html", keys=rows, project=project.name, scopes=SCOPES, created=created, fault=fault
    )
