"""Identification of nonlinear systems with unknown time delays.

The face of the library and of the service's client. Each name is loaded on first use, so
`import lagid` is fast.

Examples
--------
>>> import numpy as np
>>> from lagid import Channel, Record, identify, load_model
>>> t = np.arange(60) * 0.1  # s
>>> u = Channel("u", t, np.where(t < 1.0, 0.0, 1.0))
>>> y = Channel("y", t, 2.0 * (1.0 - np.exp(-np.maximum(t - 1.8, 0.0) / 0.5)))
>>> found = identify(load_model("fopdt"), Record((u,), (y,)))
>>> round(next(estimate.value for estimate in found.parameters if estimate.name == "L"), 2)
0.8
"""

import gc
import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

__version__ = "0.1.0"

_DISTRIBUTION = "lagid"

_ALLOCATIONS_UNTIL_COLLECTION = 50_000
"""Containers made before the garbage collector looks for cycles; Python's default is 700."""


def __dir__() -> list[str]:
    return [*globals()["__all__"], "__version__"]


def main() -> None:
    """Run the command line."""
    # Almost nothing that imports allocate is ever freed, but looking for it takes a fifth of the
    # time of a short command.
    gc.set_threshold(_ALLOCATIONS_UNTIL_COLLECTION)
    from service.cli.main import main as run_command_line

    run_command_line()


def _describe_clash() -> str | None:
    """Describe which package of another origin has the name of one of lagid's; None if none.

    Another distribution may install a package of the same name, into the same folder or into one
    that Python searches first. So may a folder of the user's own.
    """
    for package in ("sysid", "service"):
        try:
            module = import_module(package)
        except Exception as error:  # noqa: BLE001 - whatever a foreign package does when loaded
            return f"lagid cannot load its package {package!r} ({error}). {_advise(package)}"
        if getattr(module, "_DISTRIBUTION", None) != _DISTRIBUTION:
            place = getattr(module, "__file__", None) or next(iter(module.__path__), "nowhere")
            return f"{place} is not the package {package!r} of lagid. {_advise(package)}"
    return None


def _advise(package: str) -> str:
    from importlib.metadata import packages_distributions

    others = sorted({*packages_distributions().get(package, ())} - {_DISTRIBUTION})
    if not others:
        return "Rename or move what is there, or start Python in another folder."
    names = " ".join(others)
    return (
        f"It comes from {names}. Run `pip uninstall {names}`, then `pip install "
        "--force-reinstall --no-deps lagid`. Or keep each in an environment of its own."
    )


if (_clash := _describe_clash()) is not None:
    if [Path(word).stem for word in sys.argv[:1]] == [__name__]:  # the command: no traceback
        sys.exit(f"lagid: {_clash}")
    raise ImportError(_clash)

if TYPE_CHECKING:
    from service.client.async_client import AsyncClient as AsyncClient
    from service.client.calls import ClientError as ClientError
    from service.client.calls import NotFinite as NotFinite
    from service.client.calls import ProblemError as ProblemError
    from service.client.calls import ServerUnreachable as ServerUnreachable
    from service.client.calls import WaitTimeout as WaitTimeout
    from service.client.client import Client as Client
    from service.client.embedded import run_embedded_service as run_embedded_service
    from service.core.errors import ServiceDidNotStart as ServiceDidNotStart
    from service.formats.recordings import read_recording as read_recording
    from sysid import *  # noqa: F403  # the names of the library

from sysid.core.lazy_names import put_off_imports  # noqa: E402  # `sysid` is that of lagid

put_off_imports(globals())
