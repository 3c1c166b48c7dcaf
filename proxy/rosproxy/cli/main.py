"""The commands ``rosproxy run`` and ``rosproxy lan-relay``; `questions` has the other commands.

Commands import other modules when they run, so that a health check starts fast.
"""

import os
from typing import Any

import click

from rosproxy import __version__
from rosproxy.cli import options, questions
from rosproxy.shared import fixes
from rosproxy.shared import setting_kinds as kinds
from rosproxy.shared.settings import Settings


@click.group(cls=options.Commands, context_settings=options.GROUP_SETTINGS)
@click.version_option(__version__, prog_name="rosproxy")
def main() -> None:
    """Transparent proxy for ROS: nodes behind it and nodes outside talk both ways."""
    fixes.speak_for(os.environ.get(fixes.VARIABLE, ""))


@main.command(context_settings={"auto_envvar_prefix": "ROSPROXY", "show_default": True})
@options.settings_options(Settings)
@options.log_format_option
@options.config_option
@click.option(
    "--check",
    is_flag=True,
    allow_from_autoenv=False,
    help="Check the options and the files that they name, and exit.",
)
@click.option(
    "--deep",
    is_flag=True,
    allow_from_autoenv=False,
    help="With --check: also look up the hosts, bind the ports, ask the master, and try the range "
    "from outside. Exit with 0 if no error was found, else with 1.",
)
def run(check: bool, deep: bool, log_format: str, **given: Any) -> None:
    """Run the proxy.

    The command line overrides the environment variable, and the variable overrides the file of
    --config.
    """
    from rosproxy.shared.output import logs

    if deep and not check:
        raise click.UsageError("--deep needs --check")
    with options.setting_errors():
        settings = kinds.make_settings(Settings, given)
        logs.set_up(log_format, settings.log_level)
        unknown = options.unknown_variables(main)
        if not check:
            from rosproxy.app import process

            process.run(settings, {variable.name: variable.text for variable in unknown})
        else:
            _check(settings, deep)


def _check(settings: Any, deep: bool) -> None:
    """Check the files of the options, and with ``deep`` print findings and exit.

    Raises SettingError.
    """
    from rosproxy.app.policy_sources import check_policy_file
    from rosproxy.zenoh.site_links import SiteLinks

    check_policy_file(settings)
    SiteLinks(settings).check()
    if deep:
        from rosproxy.cli.deep_check import deep_check
        from rosproxy.cli.questions import print_findings

        print_findings(deep_check(settings), as_json=False)


@main.command(context_settings={"auto_envvar_prefix": "ROSPROXY_LAN_RELAY", "show_default": True})
@click.option(
    "--domain", type=options.click_type(kinds.DOMAIN), default=0, help="The ROS 2 domain."
)
@click.option(
    "--lan",
    type=options.click_type(kinds.ADDRESS),
    required=True,
    help="This host's address on the LAN.",
)
@click.option(
    "--bind",
    type=options.click_type(kinds.HOST_PORT),
    required=True,
    help="Address and port at which the proxy reaches this program: the proxy's --ros2-lan-relay.",
)
@click.option(
    "--proxy",
    type=options.click_type(kinds.HOST_PORT),
    required=True,
    help="Address of the proxy, as this host reaches it, and the first port of the proxy's range.",
)
@click.option(
    "--secret",
    type=options.click_type(kinds.TOKEN),
    required=True,
    help="Secret that the proxy has as --ros2-lan-relay-secret. Prefer the variable: all users of "
    "the machine can see a command line.",
)
@options.log_options
@options.config_option
def lan_relay(log_format: str, log_level: str, **given: Any) -> None:
    """Pass ROS 2 discovery on between a LAN and the proxy.

    Run this command in the host's network. User data passes through the ports that the host
    publishes, not through the LAN relay.
    """
    from rosproxy.app.lan_relay_program import run_lan_relay
    from rosproxy.ros2.lan_relay.relay import LanRelaySettings
    from rosproxy.shared.output import logs

    with options.setting_errors():
        logs.set_up(log_format, log_level)
        options.unknown_variables(main)
        run_lan_relay(LanRelaySettings(**given))


for command in (questions.status, questions.health, questions.doctor):
    main.add_command(command)
