"""Settings of a proxy from the real command line."""

import os
from collections.abc import Iterator, Mapping
from typing import Any
from unittest import mock

import click

from rosproxy.cli.main import run
from rosproxy.cli.options import OneLineError
from rosproxy.shared.setting_kinds import SettingError, make_settings
from rosproxy.shared.settings import Settings


def parse_settings(options: Mapping[str, Any]) -> Settings:
    """The settings of ``rosproxy run`` with options and an empty environment.

    Raises SettingError for the first value that can't be used.
    """
    return _run(
        [argument for name, value in options.items() for argument in _arguments(name, value)], {}
    )


def settings_of(variables: Mapping[str, str]) -> Settings:
    """The settings of ``rosproxy run`` with an environment. Raises SettingError."""
    return _run([], variables)


def _run(arguments: list[str], variables: Mapping[str, str]) -> Settings:
    with mock.patch.dict(os.environ, variables, clear=True):
        try:
            values = run.make_context("run", arguments).params
        except click.UsageError as error:
            option, _, message = OneLineError(error, "rosproxy").message.partition(": ")
            raise SettingError(option, message) from None
    return make_settings(Settings, values)


def _arguments(name: str, value: Any) -> Iterator[str]:
    option = f"--{name.replace('_', '-')}"
    for single_value in value if isinstance(value, tuple | list) else (value,):
        if single_value is True:
            yield option
        elif single_value is not None and single_value is not False:
            yield f"{option}={single_value}"
