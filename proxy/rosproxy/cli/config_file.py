"""The file of ``--config``: options by name, in TOML.

The command line and the variables override the file. The program parses and checks a value of the
file like the value of the same option on the command line. An unknown key is an error, like an
unknown option.
"""

import difflib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

LONGEST_FILE_BYTES = 1024 * 1024
"""Largest file that the program reads, in bytes."""
_COMMAND_LINE_ONLY = frozenset({"config", "check", "deep", "once", "help", "version"})
"""Options that a file may not have, because they choose what a single run does."""


def read_config(path: str, options: Mapping[str, click.Option]) -> dict[str, Any]:
    """Read the values in a file, by the parameter names of the options.

    ``options`` maps option names, without ``--``, to options. Raises ValueError, which says what is
    wrong.
    """
    try:
        with Path(path).open("rb") as file:
            text = file.read(LONGEST_FILE_BYTES + 1)
        if len(text) > LONGEST_FILE_BYTES:
            raise ValueError(f"{path} is longer than {LONGEST_FILE_BYTES} bytes")
        table = tomllib.loads(text.decode())
    except OSError as error:
        raise ValueError(f"{path} can't be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not UTF-8 text") from None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        reason = f'{error}; write an option as port-range = "A-B"'
        raise ValueError(f"{path} is not TOML: {reason}") from None
    values = {}
    for key, value in table.items():
        option = options.get(key)
        if option is None or key in _COMMAND_LINE_ONLY:
            raise ValueError(f"{path}: {_unknown(key, options)}")
        values[str(option.name)] = _value(f"{path}: {key}", value, option)
    return values


def _unknown(key: str, options: Mapping[str, click.Option]) -> str:
    near = difflib.get_close_matches(key.lower(), sorted({*options} - _COMMAND_LINE_ONLY), 1)
    hint = f"did you mean {near[0]}?" if near else "keys are the names of options, without --"
    return f"unknown key {key[:40]!r}; {hint}"


def _value(label: str, value: Any, option: click.Option) -> Any:
    """Convert a TOML value for the option. Raises ValueError, which begins with ``label``."""
    if option.is_flag:
        if not isinstance(value, bool):
            raise ValueError(f"{label} must be true or false")
        return value
    if isinstance(value, list):
        if not option.multiple:
            raise ValueError(f"{label} takes one value, not a list")
        return [_text(label, v) for v in value]
    return [_text(label, value)] if option.multiple else _text(label, value)


def _text(label: str, value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError(f"{label} must be a text in quotes, or a number")
    return str(value)
