"""Settings in effect with their sources, to be shown: secrets of addresses are hidden."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pydantic_settings import DotEnvSettingsSource, EnvSettingsSource

from service.core.settings import Settings

Source = Literal["default", "environment", "lagid.env", "command line"]
HIDDEN = "•••"
_USER = re.compile(r"(?<=://).*@", re.DOTALL)
_QUERY = re.compile(r"\?.*", re.DOTALL)


@dataclass(frozen=True, slots=True)
class ShownSetting:
    """A setting: its variable, its value as text, where that comes from, and what it is."""

    variable: str
    value: str
    source: Source
    text: str


def list_settings(settings: Settings) -> list[ShownSetting]:
    """List all settings of a process, in the order of their documentation."""
    prefix = str(Settings.model_config["env_prefix"])
    environment, file = EnvSettingsSource(Settings)(), DotEnvSettingsSource(Settings)()
    read = _read_again()
    shown = []
    for name, field in Settings.model_fields.items():
        value = getattr(settings, name)
        source: Source = "default"
        if name in settings.model_fields_set:
            is_read = read is not None and getattr(read, name) == value
            source = _find_source(name, environment, file) if is_read else "command line"
        text = " ".join((field.description or "").split())
        shown.append(ShownSetting(f"{prefix}{name.upper()}", _format(value), source, text))
    return shown


def hide_secrets(address: str) -> str:
    """Hide user, password and query of an address; another text stays as it is.

    Examples
    --------
    >>> hide_secrets("postgresql://lagid:secret@db/lagid?sslkey=a")
    'postgresql://•••@db/lagid?•••'
    """
    if "://" not in address:
        return address
    return _QUERY.sub(f"?{HIDDEN}", _USER.sub(f"{HIDDEN}@", address))


def _read_again() -> Settings | None:
    try:
        return Settings()
    except ValueError:  # the environment is another one than at the start
        return None


def _find_source(name: str, environment: Mapping[str, Any], file: Mapping[str, Any]) -> Source:
    if name in environment:
        return "environment"
    return "lagid.env" if name in file else "command line"


def _format(value: object) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "–"
    return hide_secrets(str(value)) or "–"
