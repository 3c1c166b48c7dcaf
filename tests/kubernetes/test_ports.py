"""The ports of proxies, and conflicts with other pods."""

import pytest

from tests.docker.engine import wait_until
from tests.kubernetes.cluster.control_plane import SCHEDULER
from tests.kubernetes.cluster.programs import paused
from tests.kubernetes.pods import Namespace
from tests.kubernetes.rosproxies import NOWHERE, RosProxy, rosproxy


def window(first: int, last: int) -> dict[str, int]:
    return {"first": first, "last": last}


def ports_on(made: RosProxy, node: str) -> str:
    """The range on a node once a proxy is there that nothing keeps from running."""
    seen: list[str] = []

    def runs() -> bool:
        seen.append(_range(made, node))  # kept: a proxy that is made anew may be gone by then
        return bool(seen[-1])

    wait_until(runs, 60, lambda: f"a proxy on {node}: {made.tell()}")
    return seen[-1]


def _range(made: RosProxy, node: str) -> str:
    """The range of the proxy that runs on a node; empty if none does."""
    proxy = made.proxy_on(node)
    running = proxy is not None and proxy.body.get("status", {}).get("phase") == "Running"
    return proxy.ports if proxy and running else ""


def test_ports_of_another_pod_are_left_alone(net: Namespace) -> None:
    net.idle(on="node1", labels={}, ports=(12005,)).wait_ready()
    made = rosproxy(net.name, master=NOWHERE, ports=8, portWindow=window(12000, 12040))
    net.idle(on="node1")
    net.idle(on="node2")
    assert ports_on(made, "node1") == "12006-12013"
    assert ports_on(made, "node2") == "12000-12007"
    made.wait_status(lambda s: "12006-12013" in s.get("ports", ""), "both ranges are told")


def test_two_rosproxies_share_a_node(net: Namespace) -> None:
    first, second = (
        rosproxy(net.name, name, master=NOWHERE, ports=8, portWindow=window(12100, 12140))
        for name in ("first", "second")
    )
    net.idle(on="node1", labels={"rosproxy.io/inject": "first"})
    net.idle(on="node1", labels={"rosproxy.io/inject": "second"})
    ranges = {ports_on(first, "node1"), ports_on(second, "node1")}
    assert ranges == {"12100-12107", "12108-12115"}


@pytest.mark.parametrize("excluded", [(29990, 32775), (32760, 61020)])
def test_node_ports_and_ephemeral_ports_are_never_taken(
    excluded: tuple[int, int], net: Namespace
) -> None:
    made = rosproxy(net.name, master=NOWHERE, ports=12, portWindow=window(*excluded))
    net.idle(on="node1")
    if excluded == (29990, 32775):
        condition = made.wait_for("PortsAllocated", "False")
        assert "29990-32775" in condition["message"], condition
        made.wait_event("PortsExhausted")
        assert made.proxies == []
    else:
        assert ports_on(made, "node1") == "61000-61011"


def test_range_is_kept_when_the_proxy_goes_and_comes(net: Namespace) -> None:
    blocker = net.idle(on="node1", labels={}, ports=(12200,))
    blocker.wait_ready()
    made = rosproxy(
        net.name, master=NOWHERE, ports=4, portWindow=window(12200, 12240), graceSeconds=1
    )
    pod = net.idle(on="node1")
    assert ports_on(made, "node1") == "12201-12204"
    blocker.remove(grace=0)
    pod.remove(grace=0)
    wait_until(lambda: not made.proxies, 40, lambda: f"no pods, no proxy: {made.tell()}")
    assert made.on("node1")["ports"] == "12201-12204"
    net.idle(on="node1")
    assert ports_on(made, "node1") == "12201-12204"


def test_ports_that_the_scheduler_gives_to_another(net: Namespace) -> None:
    """Both pods wait for the scheduler, and the other pod has waited longer."""
    made = rosproxy(net.name, master=NOWHERE, ports=4, portWindow=window(12300, 12340))
    with paused(SCHEDULER):
        other = net.idle(on="node1", labels={}, ports=(12302,))
        net.pod("sleep", "infinity", nodeName="node1")
        wait_until(lambda: bool(made.proxies), 60, made.tell)
        assert made.proxies[0].ports == "12300-12303"
    assert ports_on(made, "node1") == "12304-12307"
    other.wait_ready()
    made.wait_event("PortConflict")


def test_ports_taken_while_the_proxy_is_made_anew(net: Namespace) -> None:
    """While the ports are free for a moment, another pod is bound to the node by hand."""
    made = rosproxy(net.name, master=NOWHERE, ports=4, portWindow=window(12500, 12540))
    net.idle(on="node1")
    assert ports_on(made, "node1") == "12500-12503"
    with paused(SCHEDULER):
        made.proxies[0].remove()
        wait_until(lambda: bool(made.proxies), 60, made.tell)
        assert made.proxies[0].ports == "12500-12503"
        other = net.pod("sleep", "infinity", labels={}, ports=(12502,), nodeName="node1")
        other.wait_ready()
    assert ports_on(made, "node1") in ("12503-12506", "12504-12507")
    made.wait_event("PortConflict")
    assert other.ready


def test_number_of_ports_is_changed(net: Namespace) -> None:
    made = rosproxy(net.name, master=NOWHERE, ports=4, portWindow=window(12400, 12440))
    net.idle(on="node1")
    assert ports_on(made, "node1") == "12400-12403"
    made.change(ports=6)
    wait_until(lambda: _range(made, "node1") == "12400-12405", 60, made.tell)
