"""The user's defaults: a configuration file, and environment variables that override it.

The file is ~/.config/dior-rt/config.toml (%APPDATA%\dior-rt on Windows), or what DIOR_CONFIG names:

    preset = "fast"        # for every command that has the option
    device = "cpu"

    [batch]                # for one command
    format = "jpg"

DIOR_PRESET=balanced goes over the file, and an option on the command line over both.
"""

from __future__ import annotations

import os
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from dior_rt.errors import InputError
from dior_rt.files import reason

PREFIX: Final = "DIOR_"
CONFIG: Final = "DIOR_CONFIG"
MOST_BYTES: Final = 1 << 20

#: The options that may have a default: they say how to work, not what to work on.
SETTINGS: Final = (
    *("bundle", "device", "ops", "preset", "steps", "solver", "shift", "guidance", "interval", "tolerance"),
    *("seed", "intensity", "reach", "format", "overwrite", "quiet", "at-once", "in-flight"),
)
COMMANDS: Final = ("relight", "batch", "estimate", "devices", "bench")


@dataclass(frozen=True)
class Default:
    """One default.

    command: the command it applies to, or None for all that have the option. source: its place.
    """

    setting: str
    value: str | list[str]
    source: str
    command: str | None = None


def config_path(environment: Mapping[str, str] = os.environ) -> Path:
    """Return the path of the configuration file, whether or not it exists."""
    if named := environment.get(CONFIG):
        return Path(named)
    if sys.platform == "win32" and (folder := environment.get("APPDATA")):
        return Path(folder) / "dior-rt" / "config.toml"
    above = (
        environment.get("XDG_CONFIG_HOME") or Path(environment.get("HOME") or "~").expanduser() / ".config"
    )
    return Path(above) / "dior-rt" / "config.toml"


def read_defaults(environment: Mapping[str, str] = os.environ) -> list[Default]:
    """Return the defaults in order, so that later ones override earlier ones.

    Raises InputError for an invalid file.
    """
    found = _read_file(config_path(environment), must=CONFIG in environment)
    for setting in SETTINGS:
        name = variable(setting)
        if text := environment.get(name):
            found.append(Default(setting, text.split() if setting == "interval" else text, name))
    return found


def defaults_of(command: str, defaults: list[Default]) -> dict[str, str | list[str]]:
    """Return a command's defaults, by the names of its parameters."""
    general = {d.setting: d.value for d in defaults if d.command is None and not d.source.startswith(PREFIX)}
    special = {d.setting: d.value for d in defaults if d.command == command}
    variables = {d.setting: d.value for d in defaults if d.source.startswith(PREFIX)}
    merged = {**general, **special, **variables}
    return {setting.replace("-", "_"): value for setting, value in merged.items()}


def unknown_variables(environment: Mapping[str, str] = os.environ) -> list[str]:
    """Return the variables that look like defaults but are none."""
    choices = {CONFIG, *map(variable, SETTINGS)}
    return sorted(name for name in environment if name.startswith(PREFIX) and name not in choices)


def variable(setting: str) -> str:
    """Return the environment variable of a setting, such as DIOR_AT_ONCE."""
    return PREFIX + setting.upper().replace("-", "_")


def _read_file(path: Path, must: bool) -> list[Default]:
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise ValueError(f"it is longer than {MOST_BYTES} bytes")
        document = tomllib.loads(data.decode())
    except FileNotFoundError as error:
        if must:
            raise InputError(f"{CONFIG} names {path}, and there is no such file.") from error
        return []
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"Cannot read the configuration {path}: {reason(error)}.") from error
    found = []
    for key, value in document.items():
        if isinstance(value, dict):
            if key not in COMMANDS:
                choices = ", ".join(COMMANDS)
                raise InputError(f"{path}: there is no command [{key}] to configure. There are {choices}.")
            found += [_default(name, inner, path, key) for name, inner in value.items()]
        else:
            found.append(_default(key, value, path, None))
    return found


def _default(setting: str, value: Any, path: Path, command: str | None) -> Default:
    setting = setting.replace("_", "-")
    if setting not in SETTINGS:
        raise InputError(f"{path}: {setting!r:.40} is no setting. There are {', '.join(SETTINGS)}.")
    if isinstance(value, list) and setting == "interval":
        return Default(setting, [str(item) for item in value], str(path), command)
    if not isinstance(value, (str, int, float)):
        raise InputError(f"{path}: {setting} must be a text, a number, true or false.")
    return Default(setting, str(value).lower() if isinstance(value, bool) else str(value), str(path), command)
