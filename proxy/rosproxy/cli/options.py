"""Kinds of values and usage errors, for the command lines of the proxy and of the operator.

Each kind of value is a click type. So the program reports a bad value before the start, whether the
value comes from the command line or from the environment. A usage error is a single line, for logs
of containers: the program, the option, what is wrong, and a valid value. The exit status is 2.
"""

import contextlib
import logging
import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, get_args

import click

from rosproxy.cli import variables
from rosproxy.cli.config_file import read_config
from rosproxy.cli.variables import UnknownVariable
from rosproxy.shared import setting_kinds as kinds
from rosproxy.shared.fixes import VARIABLE
from rosproxy.shared.setting_kinds import Setting, SettingError, declared

Command = Callable[..., Any]
GROUP_SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 100}


class Parsed(click.ParamType):  # type: ignore[type-arg] # no generic type before click 8.4
    """A kind of value that the pure function ``read`` parses from a text.

    Help texts show ``name``. ``read`` raises ValueError. The message says what is wrong with the
    text, and gives an example. ``separable``: in a variable, spaces separate several values.
    """

    def __init__(self, name: str, read: Callable[[str], Any], separable: bool = True) -> None:
        self.name = name
        self._read = read
        self._separable = separable

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The value of a text. Raises click.BadParameter."""
        try:
            return self._read(value) if isinstance(value, str) else value
        except ValueError as error:
            self.fail(str(error), param, ctx)

    def split_envvar_value(self, rv: str) -> Sequence[str]:
        """Split the text of a variable into values, for a repeatable option."""
        # click splits at spaces, but the rules of a policy contain spaces.
        return super().split_envvar_value(rv) if self._separable else [rv]


class Seconds(click.FloatRange):
    """A time in seconds, of at most a day."""

    name = "s"

    def __init__(self, least: float) -> None:
        super().__init__(least, kinds.DAY_S)

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """The value of a text. Raises click.BadParameter."""
        seconds = float(click.FLOAT.convert(value, param, ctx))
        if math.isnan(seconds) or not 0 <= (self.min or 0) <= seconds <= kinds.DAY_S:
            self.fail(f"{seconds:g} s is not between {self.min:g} and {kinds.DAY_S} s", param, ctx)
        return seconds


def click_type(kind: kinds.Text | kinds.Number) -> click.ParamType:  # type: ignore[type-arg]
    """The click type of a kind of value."""
    if isinstance(kind, kinds.Text):
        return Parsed(kind.form, kind.read, kind.separable)
    if kind.seconds:
        return Seconds(kind.least)
    number = click.IntRange(int(kind.least), int(kind.most))
    number.name = kind.form
    return number


def settings_options(*settings: type) -> Callable[[Command], Command]:
    """A decorator that adds the options of classes whose fields have an `Option`."""
    described = [setting for kind in settings for setting in declared(kind)]
    return lambda command: with_options(command, [click_option(s) for s in described])


def click_option(setting: Setting, prefix: str = "") -> Callable[[Command], Command]:
    """A decorator that adds the option of a setting; ``prefix`` stands before the name."""
    option = setting.option
    form = _form(setting)
    if setting.default not in (None, "", ()):
        form |= {"default": setting.default, "show_default": option.default or True}
    name = f"--{prefix}{setting.name.removeprefix('--')}"
    return click.option(
        f"{name}/--no-{name.removeprefix('--')}" if setting.default is True else name,
        envvar=list(option.variables) or None,
        allow_from_autoenv=not option.variables,  # click would also read the automatic variable
        multiple=option.repeatable,
        required=setting.required,
        help=plain(option.help),
        **form,
    )


def _form(setting: Setting) -> dict[str, Any]:
    """The arguments of `click.option` for the kind: a click type, a choice of words, or a flag."""
    if setting.option.kind:
        return {"type": click_type(setting.option.kind)}
    words = [word for word in setting.words if word]  # an empty word stands for the default
    if not words:
        return {"is_flag": True}
    return {"type": click.Choice(words, case_sensitive=not setting.option.any_case)}


def plain(markdown: str) -> str:
    """A Markdown text without links and code marks."""
    return re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", markdown).replace("`", "")


class OneLineError(click.ClickException):
    """A usage error of ``program``, printed as a single line."""

    exit_code = 2

    def __init__(self, error: click.UsageError, program: str) -> None:
        super().__init__(_usage_text(error))
        self.program = program

    def show(self, file: Any = None) -> None:
        """Print the error."""
        click.echo(f"{self.program}: {self.format_message()}", file, err=True)


class CommandShowingVariables(click.Command):
    """A command or group whose help names the variables of the options."""

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """The options and arguments of the command."""
        params = super().get_params(ctx)
        for param in params:
            if isinstance(param, click.Option) and variables_of(param, ctx.auto_envvar_prefix):
                param.show_envvar = True
        return params


def variables_of(option: click.Option, prefix: str | None) -> list[str]:
    """The variables from which click reads an option; ``prefix`` is the prefix of the command."""
    if option.envvar:
        return [option.envvar] if isinstance(option.envvar, str) else list(option.envvar)
    # The same rule as click's (core.py, Option.resolve_envvar_value). --help and --version expose
    # no value, and have no variable.
    automatic = prefix and option.allow_from_autoenv and option.expose_value
    automatic = automatic or (prefix and option.name == "config")
    return [f"{prefix}_{option.name}".upper().replace("-", "_")] if automatic else []


class Commands(CommandShowingVariables, click.Group):
    """Commands whose usage errors are a single line that begins with the name of the program.

    Without this class, click prints four lines.
    """

    program = "rosproxy"
    command_class = CommandShowingVariables

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        """Parse the words before the command. Raises OneLineError."""
        with _in_one_line(self.program):
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: click.Context) -> Any:
        """Parse the words of the command, and run the command. Raises OneLineError."""
        with _in_one_line(self.program):
            return super().invoke(ctx)


def with_options(command: Command, options: Sequence[Callable[[Command], Command]]) -> Command:
    """A command with these options, in the order of the help text."""
    for option in reversed(options):
        command = option(command)
    return command


def log_format_option(command: Command) -> Command:
    """A decorator that adds the option ``--log-format``."""
    return click.option(
        "--log-format",
        type=click.Choice(["text", "json"]),
        default="text",
        help="Format of the log.",
    )(command)


def log_options(command: Command) -> Command:
    """A decorator that adds the options ``--log-format`` and ``--log-level``.

    ``rosproxy run`` has ``--log-level`` from its settings.
    """
    level = click.option(
        "--log-level",
        type=click.Choice(get_args(kinds.LogLevel), case_sensitive=False),
        default="info",
        help="Lowest severity that is logged.",
    )
    return log_format_option(level(command))


def config_option(command: Command) -> Command:
    """A decorator that adds ``--config``: command line and variables override this file."""
    return click.option(
        "--config",
        metavar="FILE",
        # Eager: this option fills context.default_map, which the other options read.
        is_eager=True,
        expose_value=False,
        callback=_use_config,
        help='File in TOML with options by name, for example port-range = "11000-11099".',
    )(command)


def _use_config(context: click.Context, option: click.Parameter, path: str | None) -> None:
    if path is None:
        return
    options = [o for o in context.command.params if isinstance(o, click.Option)]
    option_by_name = {name.removeprefix("--"): o for o in options for name in o.opts[:1]}
    try:
        context.default_map = read_config(path, option_by_name)
    except ValueError as error:
        raise click.BadParameter(str(error), context, option) from None


def unknown_variables(*groups: click.Command, log: bool = True) -> list[UnknownVariable]:
    """The variables of this environment that seem meant for rosproxy, but that no option reads.

    ``groups``: the commands whose options count. ``log``: log a warning for each variable.
    """
    known_names = {name for group in groups for name in _variable_names(group, None)}
    known_names.add(VARIABLE)
    unknown = variables.unknown(os.environ, known_names)
    for variable in unknown if log else ():
        logging.getLogger(__name__).warning("%s %s", variable.name, variable.text)
    return unknown


def _variable_names(command: click.Command, prefix: str | None) -> Iterator[str]:
    """The variables of a command and of its subcommands."""
    prefix = command.context_settings.get("auto_envvar_prefix", prefix)
    for param in command.params:
        if isinstance(param, click.Option):
            yield from variables_of(param, prefix)
    if isinstance(command, click.Group):
        for name, subcommand in command.commands.items():
            # The same rule as click's (core.py, Context.__init__).
            yield from _variable_names(subcommand, f"{prefix}_{name}".upper() if prefix else None)


@contextlib.contextmanager
def setting_errors() -> Iterator[None]:
    """Turn a SettingError in the context into a usage error of click."""
    try:
        yield
    except SettingError as error:
        raise click.UsageError(str(error)) from None


@contextlib.contextmanager
def _in_one_line(program: str) -> Iterator[None]:
    try:
        yield
    except click.UsageError as error:
        if "\n" in error.format_message():  # the help text, if there is no command
            raise
        raise OneLineError(error, program) from None


def _usage_text(error: click.UsageError) -> str:
    """The option and what is wrong, with the default as an example if it is a number."""
    option = error.param if isinstance(error, click.BadParameter) else None
    if not isinstance(option, click.Option):
        return error.format_message()
    name = option.opts[0]
    message = error.message.removesuffix(".")
    if isinstance(error, click.MissingParameter):
        prefix = error.ctx.auto_envvar_prefix if error.ctx else None
        variable = option.envvar or f"{prefix}_{str(option.name).upper()}"
        meaning = str(option.help).partition(". ")[0]
        if meaning[1:2].islower():  # no abbreviation, as in "IP address"
            meaning = meaning[0].lower() + meaning[1:]
        return f"{name}: missing; give {meaning} ({variable})"
    has_example = isinstance(option.default, int | float) and not isinstance(option.default, bool)
    return f"{name}: {message}" + (f"; for example {option.default:g}" if has_example else "")
