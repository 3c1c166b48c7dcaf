"""The command below ``rosproxy-operator kubernetes``: it looks, and needs no running operator.

It imports what it needs when it runs: the Kubernetes client may not be installed.
"""

import click

from rosproxy_operator.common.command_errors import exit_on_error


@click.command()
@click.argument("names", nargs=-1, metavar="[TOPIC|NODE|SERVICE]...")
@click.option("--json", "as_json", is_flag=True, help="Print it as JSON.")
@click.pass_obj
def doctor(namespaces: tuple[str, ...], names: tuple[str, ...], as_json: bool) -> None:
    """Find out what is wrong in the cluster, and say what mends it, the first cause first.

    Looks at the RosProxies, the webhook and the last Events, and asks the doctor of each proxy, in
    its pod, as you: that takes the right to create pods/exec. What you may not look at is told.
    With names: about those nodes, topics and services. Exits with 0 if nothing is wrong, with 1 if
    something is.
    """
    from rosproxy.cli.questions import print_findings
    from rosproxy_operator.kubernetes.api.api_client import ApiError
    from rosproxy_operator.kubernetes.doctor import examine

    with exit_on_error(ApiError):
        findings = examine(namespaces, names)
    print_findings(findings, as_json)
