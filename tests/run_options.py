"""Settings of a proxy by way of its real command line."""

import os
from collections.abc import Iterator, Mapping
from typing import Any
from unittest import mock

import click

from rosproxy.cli.main import run
from rosproxy.cli.options import OneLineError
from rosproxy.setting_kinds import SettingError, make_settings
from rosproxy.settings import Settings


def parse_settings(options: Mapping[str, Any]) -> Settings:
    """What ``rosproxy run`` makes of options, and of nothing in the environment.

    Raises SettingError for the first value that can't be used.
    """
    return _run([word for name, value in options.items() for word in _words(name, value)], {})


def settings_of(variables: Mapping[str, str]) -> Settings:
    """What ``rosproxy run`` makes of an environment. Raises SettingError."""
    return _run([], variables)


def _run(words: list[str], variables: Mapping[str, str]) -> Settings:
    with mock.patch.dict(os.environ, variables, clear=True):
        try:
            values = run.make_context("run", words).params
        except click.UsageError as error:
            option, _, message = OneLineError(error, "rosproxy").message.partition(": ")
            raise SettingError(option, message) from None
    return make_settings(Settings, values)


def _words(name: str, value: Any) -> Iterator[str]:
    option = f"--{name.replace('_', '-')}"
    for one in value if isinstance(value, tuple | list) else (value,):
        if one is True:
            yield option
        elif one is not None and one is not False:
            yield f"{option}={one}"
