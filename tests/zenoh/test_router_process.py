"""The router process with the zenoh library of the proxy: a change right after the start."""

import itertools
import json
import os
import subprocess
from pathlib import Path
from typing import Any

from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.policy.rules import parse_rules
from rosproxy.shared.ports import PortRange
from rosproxy.zenoh.access_control import access_control
from rosproxy.zenoh.router_configs import RouterPlan
from tests.zenoh.lab import ENVIRONMENTS, OWN_VERSION

PORTS = PortRange(7448, 7479)
"""As many as an operator gives to a proxy."""
STARTS = 12
"""Without the wait for links, 2 of 14 starts failed."""
MOST_REPORTS = 15
"""One each second."""


def is_linked(report: dict[str, Any]) -> bool:
    """Whether the hub has a link to each of the other routers."""
    *routers, hub = report["routers"]
    return {router["zid"] for router in routers} <= {end["peer"] for end in hub["sessions"]}


def test_a_router_that_changes_at_once_is_linked(tmp_path: Path) -> None:
    """The hub kept a link to the former router, and the container was alone for ever."""
    plan = RouterPlan("127.0.0.1", PORTS, None, (), directory=str(tmp_path))
    rules = access_control([PolicyLayer("rules", parse_rules("deny publish /x"))])
    changes = enumerate(({PORTS.first: rules, PORTS.last: rules}, {PORTS.first: rules}))
    lines = [json.dumps({"revision": n, "routers": plan.configs(access)}) for n, access in changes]
    python = ENVIRONMENTS / OWN_VERSION / "bin/python"
    proxy = Path(__file__).parents[2] / "proxy"
    for _ in range(STARTS):
        with subprocess.Popen(
            [python, "-m", "rosproxy.zenoh.router_process"],
            env=os.environ | {"PYTHONPATH": str(proxy)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            print(*lines, sep="\n", file=process.stdin, flush=True)
            reports = map(json.loads, itertools.islice(process.stdout, MOST_REPORTS))
            linked = any(report["revision"] and is_linked(report) for report in reports)
            process.kill()
        assert linked, f"not linked after {MOST_REPORTS} reports"
