"""Ray's folder of each dispatcher; clean-up of folders and processes of dead dispatchers.

Imports neither Ray nor NumPy.
"""

import os
import shutil
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import psutil

from sysid.core.machine import make_machine_tag

_MAX_BASE_LENGTH = 18  # rest of a socket's path, after all names and numbers of seven digits


def get_ray_folder(pid: int) -> Path:
    """Return the private folder around Ray's folder, for the dispatcher of this process number.

    Its path must be short: Ray puts sockets below it, and a socket's path has 107 bytes at most.
    """
    return _choose_base_folder() / f"{_make_folder_prefix()}{pid}"


def get_inner_folder(folder: Path) -> Path:
    """Return Ray's own folder inside the private one. Ray opens all its folders to everybody."""
    return folder / "ray"


def find_folder_processes(pid: int) -> tuple[int, ...]:
    """Find processes of Ray whose arguments name the folder of this dispatcher.

    Workers hide their arguments, but end by themselves when their raylet ends.
    """
    mark = f"{get_ray_folder(pid)}/"
    return tuple(
        process.pid
        for process in psutil.process_iter(["cmdline"])
        if any(mark in argument for argument in process.info["cmdline"] or ())
    )


def kill_processes(pids: Iterable[int]) -> None:
    """Kill processes, but never this one."""
    for pid in pids:
        if pid != os.getpid():
            with suppress(psutil.Error):  # it has ended, or is another user's
                psutil.Process(pid).kill()


def clear_ray_remains(pid: int) -> None:
    """Kill the remaining Ray processes of a dead dispatcher, and remove its folder."""
    kill_processes(find_folder_processes(pid))
    shutil.rmtree(get_ray_folder(pid), ignore_errors=True)


def clear_dead_dispatchers() -> None:
    """Clear the remains of every dead dispatcher of this machine.

    Folders of other machines are left alone: in another PID namespace the number differs.
    """
    for folder in _choose_base_folder().glob(f"{_make_folder_prefix()}*"):
        owner = folder.name.removeprefix(_make_folder_prefix())
        if owner.isdigit() and not _is_running(int(owner)):
            clear_ray_remains(int(owner))


def _is_running(pid: int) -> bool:
    try:
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.AccessDenied:
        return True
    except psutil.NoSuchProcess:
        return False


def _make_folder_prefix() -> str:
    return f"lagid-{make_machine_tag()}-"


def _choose_base_folder() -> Path:
    base = Path(tempfile.gettempdir())
    return base if len(str(base)) <= _MAX_BASE_LENGTH else Path("/tmp")
