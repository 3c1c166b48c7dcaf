"""The commands below ``rosproxy-operator kubernetes`` that need no running operator.

A command imports modules only when the command runs: the Kubernetes client may be missing.
"""

import click

from rosproxy_operator.common.command_errors import exit_on_error


@click.command()
@click.argument("names", nargs=-1, metavar="[TOPIC|NODE|SERVICE]...")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.pass_obj
def doctor(namespaces: tuple[str, ...], names: tuple[str, ...], as_json: bool) -> None:
    """Find faults in the cluster, and print how to repair each, the first cause first.

    The command checks the RosProxies, the webhook and the last Warning Events, and runs the doctor
    of each proxy in the proxy's pod. The command uses your rights: for the doctors, you need the
    right to create pods/exec. The output names missing rights. If names are given, the doctors of
    the proxies check only those nodes, topics and services. Exits with 0 if no error was found,
    else with 1.
    """
    from rosproxy.cli.questions import print_findings
    from rosproxy_operator.kubernetes.api.api_client import ApiError
    from rosproxy_operator.kubernetes.doctor import examine

    with exit_on_error(ApiError):
        findings = examine(namespaces, names)
    print_findings(findings, as_json)
