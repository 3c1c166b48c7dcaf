"""Inside has no way out.

With ``--direction out`` inside receives nothing from outside, and the doctor has the reason. With
``both`` inside receives, also from outside nodes on the proxy's machine.

The tests of both directions run in this network with ROS_TESTS_ISOLATED=1.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace

import pytest

from tests.ros.combinations import LIBRARIES, each_library
from tests.ros.lab import MASTER_URI, Lab
from tests.ros.processes import stop_all
from tests.ros.topology import MASTER_PORT, OUT_HOST, SHARED

pytestmark = pytest.mark.boundary

PLAN = replace(SHARED, name="i", isolated=True)
PROXY_OPTIONS = ("--direction", "out")


@each_library
def test_inside_is_heard_and_hears_nobody(lab: Lab, library: str) -> None:
    topic = f"/{lab.unique('topic')}"
    service = f"/{lab.unique('service')}"
    name = lab.unique("talker")
    lab.node(library, "out", "pub", name=name, topic=topic)
    deaf = lab.node(library, "c1", "sub", topic=topic)
    lab.node(library, "out", "serve", service=service)
    caller = lab.node(library, "c1", "call", service=service)
    lab.node(library, "c1", "pub", topic=f"{topic}/out")
    lab.node(library, "out", "sub", topic=f"{topic}/out").wait_for_count("^got ", 20)
    report = " ".join(lab.rosproxy("doctor", topic, check=False).output.split())
    assert "--direction both" in report, report
    assert "got " not in deaf.output()
    assert "reply " not in caller.output()


@pytest.fixture
def beside(lab: Lab) -> Iterator[dict[str, str]]:
    """A proxy for both directions on a machine with outside nodes.

    Yields the environment of inside nodes.

    The machine is the gateway of the inside network, like a Docker host with an internal network.
    """
    gateway = "172.30.1.1"
    argv = [sys.executable, "-m", "rosproxy", "run", "--master-uri", MASTER_URI]
    argv += ["--advertise-host", OUT_HOST, "--port-range", "48000-48019", "--direction", "both"]
    argv += ["--inside-network", "172.30.1.0/24"]
    proxy = lab.spawn_proxy("host", argv)
    proxy.wait_for("listening: ")
    yield {"ROS_MASTER_URI": f"http://{gateway}:{MASTER_PORT}"}
    log = proxy.output()
    assert "Traceback" not in log, log
    stop_all([proxy])


@pytest.mark.parametrize(
    ("outside_library", "inside_library"), [LIBRARIES, LIBRARIES[::-1]], ids=str
)
def test_nodes_of_outside_may_run_beside_the_proxy(
    lab: Lab, beside: dict[str, str], outside_library: str, inside_library: str
) -> None:
    """On the proxy's machine, with an address that the proxy has, too."""
    topic = f"/{lab.unique('topic')}"
    service = f"/{lab.unique('service')}"
    host_env = {"ROS_IP": OUT_HOST}
    lab.node(outside_library, "host", "pub", topic=topic, env=host_env)
    lab.node(outside_library, "host", "serve", service=service, env=host_env)
    back = lab.node(outside_library, "host", "sub", topic=f"{topic}/back", env=host_env)
    lab.node(inside_library, "c1", "sub", topic=topic, env=beside).wait_for_count("^got hello ", 5)
    lab.node(inside_library, "c1", "call", service=service, env=beside).wait_for("^reply ask 0 ")
    lab.node(inside_library, "c1", "pub", topic=f"{topic}/back", env=beside)
    back.wait_for_count("^got hello ", 5)
