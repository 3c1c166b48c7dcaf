"""What the command lines of the proxy and of the operator share: kinds of values, and usage errors.

Each kind of value is a click type, so that a bad one is told before anything starts, from the
command line and from the environment alike. All usage errors are one line, for logs of containers:
the program, the option, what is wrong and what would be right. The exit status is 2.
"""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import click

from rosproxy import settings
from rosproxy.access.rules import parse_rules

Command = Callable[..., Any]
GROUP_SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 100}


class Parsed(click.ParamType):  # type: ignore[type-arg] # no generic type before click 8.4
    """A kind of value that a pure function reads from text; help shows its name in capitals.

    ``read`` raises ValueError, whose message says what is wrong with the text and gives an example.
    """

    def __init__(self, name: str, read: Callable[[str], Any]) -> None:
        self.name, self._read = name, read

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The value of a text. Raises click.BadParameter."""
        try:
            return self._read(value) if isinstance(value, str) else value
        except ValueError as error:
            self.fail(str(error), param, ctx)


class PolicyRules(Parsed):
    """Rules of a policy; a variable's value is one text, in which spaces separate no values."""

    def __init__(self) -> None:
        super().__init__("rules", parse_rules)

    def split_envvar_value(self, rv: str) -> Sequence[str]:
        """The value of a variable, whole."""
        return [rv]


class Seconds(click.FloatRange):
    """A time of at most a day."""

    name = "s"

    def __init__(self, least: float) -> None:
        super().__init__(least, 86400)

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """The value of a text. Raises click.BadParameter."""
        seconds = float(click.FLOAT.convert(value, param, ctx))
        if math.isnan(seconds) or not 0 <= (self.min or 0) <= seconds <= 86400:
            self.fail(f"{seconds:g} s is not between {self.min:g} and 86400 s", param, ctx)
        return seconds


PORT = click.IntRange(1, 65535)
PORT.name = "port"
MEBIBYTES = click.IntRange(1, 65536)
MEBIBYTES.name = "MiB"
CONNECTIONS = click.IntRange(16, 1_000_000)
CONNECTIONS.name = "n"
PORT_RANGE = Parsed("A-B", settings.read_range)
HOST = Parsed("host", settings.read_host)
ADDRESS = Parsed("address", settings.read_address)
BIND_ADDRESS = Parsed("address", settings.read_bind_address)
HOST_PORT = Parsed("address:port", settings.read_host_port)
NETWORK = Parsed("CIDR", settings.read_network)
MASTER_URI = Parsed("URI", settings.read_master_uri)
TOKEN = Parsed("token", settings.read_token)
POLICY_RULES = PolicyRules()
POLICY_LAYERS = Parsed("JSON", settings.read_policy_layers)
TOKEN_HASH = Parsed("hash", settings.read_token_hash)


class OneLineError(click.ClickException):
    """A mistake on the command line of ``program``, told in one line."""

    exit_code = 2

    def __init__(self, error: click.UsageError, program: str) -> None:
        super().__init__(_told(error))
        self.program = program

    def show(self, file: Any = None) -> None:
        """Print it."""
        click.echo(f"{self.program}: {self.format_message()}", file, err=True)


class Commands(click.Group):
    """Commands whose usage errors are one line, led by the program's name; click prints four."""

    program = "rosproxy"

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        """Parse the words before the command. Raises OneLineError."""
        with _in_one_line(self.program):
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: click.Context) -> Any:
        """Parse the command's words and run it. Raises OneLineError."""
        with _in_one_line(self.program):
            return super().invoke(ctx)


def with_options(command: Command, options: Sequence[Callable[[Command], Command]]) -> Command:
    """A command with these options, which its help shows in this order."""
    for option in reversed(options):
        command = option(command)
    return command


def log_options(command: Command) -> Command:
    """The options ``--log-format`` and ``--log-level``."""
    form = click.option(
        "--log-format", type=click.Choice(["text", "json"]), default="text", help="Log format."
    )
    level = click.option(
        "--log-level",
        type=click.Choice(["debug", "info", "warning", "error"], case_sensitive=False),
        default="info",
        help="Least severe messages to log.",
    )
    return form(level(command))


@contextlib.contextmanager
def setting_errors() -> Iterator[None]:
    """Tell a SettingError, which comes up when options are put together, as a usage error."""
    try:
        yield
    except settings.SettingError as error:
        raise click.UsageError(str(error)) from None


@contextlib.contextmanager
def _in_one_line(program: str) -> Iterator[None]:
    try:
        yield
    except click.UsageError as error:
        if "\n" in error.format_message():  # the help, for want of a command
            raise
        raise OneLineError(error, program) from None


def _told(error: click.UsageError) -> str:
    """What is wrong, led by the option; an example if the option has a default."""
    option = error.param if isinstance(error, click.BadParameter) else None
    if not isinstance(option, click.Option):
        return error.format_message()
    name, message = option.opts[0], error.message.removesuffix(".")
    if isinstance(error, click.MissingParameter):
        prefix = error.ctx.auto_envvar_prefix if error.ctx else None
        variable = option.envvar or f"{prefix}_{str(option.name).upper()}"
        return f"{name}: missing; give {option.help} ({variable})"
    given = isinstance(option.default, int | float) and not isinstance(option.default, bool)
    return f"{name}: {message}" + (f"; for example {option.default:g}" if given else "")
