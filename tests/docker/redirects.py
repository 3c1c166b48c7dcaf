"""Redirects of containers with an address in ROS_MASTER_URI."""

from tests.docker.controller import the_proxy
from tests.docker.engine import inspect, run, wait_until
from tests.docker.inside import Container, Inside
from tests.docker.robot import Robot


def rules(container: Container) -> str:
    """The nftables rules in a container's network; empty without a redirect."""
    pid = inspect(container.name)["State"]["Pid"]
    text = run("nsenter", f"--net=/proc/{pid}/ns/net", "nft", "list", "tables")
    tables = [line.split()[-1] for line in text.splitlines() if "rosproxy-redirect" in line]
    return "\n".join(
        run("nsenter", f"--net=/proc/{pid}/ns/net", "nft", "list", "table", "ip", table)
        for table in tables
    )


def leads_to_the_proxy(container: Container, network: str) -> bool:
    settings = inspect(the_proxy().sandbox, check=False).get("NetworkSettings", {})
    address = settings.get("Networks", {}).get(network, {}).get("IPAddress")
    return bool(address) and f"dnat to {address}:11311" in rules(container)


def redirected(container: Container, network: str) -> None:
    """Wait until the master's address leads the container to the proxy."""
    wait_until(lambda: leads_to_the_proxy(container, network), 30, lambda: rules(container))


def addressed_talker(
    near: Inside, network: str, robot: Robot, library: str = "roscpp"
) -> Container:
    """A node that publishes, known to the master by the proxy."""
    node = near.node(network, library, "pub", "--topic", "/out", "--word", "inside")
    wait_until(lambda: robot.knows_proxied(node.node), 60, node.log.read)
    return node
