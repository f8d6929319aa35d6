"""A progress bar for a job that is waited for."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from service.client.documents import JobDocument


@contextmanager
def show_progress(job: str, *, is_shown: bool) -> Iterator[Callable[["JobDocument"], None]]:
    """Show a bar on stderr during the block; yields a function that takes each state of the job."""
    if not is_shown:
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("runs, {task.fields[state]}", markup=False),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task(job, state="queued", total=None)

        def advance(state: "JobDocument") -> None:
            done = state["progress"]
            progress.update(
                bar, completed=done["finished"], total=done["runs"], state=state["state"]
            )

        yield advance
