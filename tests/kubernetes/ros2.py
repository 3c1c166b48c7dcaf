"""Nodes of ROS 2: in pods, and on a robot on the nodes' LAN, outside of the cluster."""

import itertools
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosproxy.shared.documents.status_document import DomainStatus, parse_status
from tests.docker.engine import docker, inspect
from tests.docker.images import ROS2, build_image
from tests.docker.nodes import Log
from tests.docker.ros2 import command
from tests.kubernetes import api
from tests.kubernetes.api import Json
from tests.kubernetes.cluster.images import load_images
from tests.kubernetes.cluster.network import plug_in_robot, unplug_robot
from tests.kubernetes.pods import Namespace, Pod, unique
from tests.kubernetes.rosproxies import Proxy, RosProxy

NAME = "rosproxy-cluster-robot2"
ADDRESS = "10.88.0.51"
CABLE = "rpxrobot2"
_CYCLONE = (
    "<CycloneDDS><Domain><Discovery><ParticipantIndex>auto</ParticipantIndex><Peers>"
    '<Peer Address="$(ROS_STATIC_PEERS)"/></Peers></Discovery></Domain></CycloneDDS>'
)
"""The setting that ROS 2's layer above Cyclone DDS, missing here, makes from ROS_STATIC_PEERS."""
_numbers = itertools.count(1)


@dataclass(frozen=True)
class Robot2:
    """A robot with ROS 2 and multicast. ``root`` is its file system."""

    root: Path

    def node(
        self, vendor: str, kind: str, topic: str, *options: str, domain: int = 0, name: str = ""
    ) -> Log:
        """Start a node with its output in a file."""
        name = name or f"robot_{kind}_{next(_numbers)}"
        words = " ".join(command(vendor, kind, topic, *options, "--name", name))
        file = f"/tmp/{name}.log"
        script = f"echo $$ >/tmp/{name}.pid; exec {words} >{file} 2>&1"
        variable = ("--env", f"ROS_DOMAIN_ID={domain}")
        docker("exec", "--detach", *variable, NAME, "setsid", "sh", "-c", script)
        path = self.root / file.lstrip("/")
        return Log(lambda: path.read_text() if path.exists() else "")

    def end(self, name: str) -> None:
        """End a node as users do."""
        docker("exec", NAME, "sh", "-c", f"kill -INT $(cat /tmp/{name}.pid); rm /tmp/{name}.pid")

    def end_all(self) -> None:
        """Kill all nodes."""
        script = "kill -KILL $(cat /tmp/*.pid); rm -f /tmp/*.pid"
        docker("exec", NAME, "sh", "-c", script, check=False)


@contextmanager
def robot_with_ros2() -> Iterator[Robot2]:
    """The robot on the LAN, and the image with ROS 2 on all nodes."""
    load_images(build_image(ROS2))
    docker("rm", "--force", NAME, check=False)
    docker("run", "--detach", "--init", "--network", "none", "--name", NAME,
           ROS2, "sleep", "infinity")  # fmt: skip
    process = str(inspect(NAME)["State"]["Pid"])
    plug_in_robot(process, ADDRESS, CABLE)
    try:
        yield Robot2(Path(f"/proc/{process}/root"))
    finally:
        docker("rm", "--force", NAME, check=False)
        unplug_robot(CABLE)


def node(
    net: Namespace, vendor: str, kind: str, topic: str, *options: str,
    env: Mapping[str, str] | None = None, **more: Any,
) -> Pod:  # fmt: skip
    """Start a pod with a node of ROS 2, as a user would: an image, a command and a label."""
    name = more.pop("name", "") or unique(kind)
    words = command(vendor, kind, topic, *options, "--name", Pod(net.name, name).node)
    told = {**({"CYCLONEDDS_URI": _CYCLONE} if vendor == "cyclone" else {}), **(env or {})}
    more.setdefault("image", ROS2)
    return net.pod(*words, name=name, env=told, **more)


def lan_relays(of: RosProxy) -> list[Json]:
    """The pods of a RosProxy's LAN relays."""
    bodies = api.objects("pods", of.namespace, "app.kubernetes.io/component=lan-relay")
    return [body for body in bodies if "deletionTimestamp" not in body["metadata"]]


def domain(proxy: Proxy) -> DomainStatus:
    """The status of a proxy's domain; empty while the proxy does not answer."""
    try:
        (status,) = parse_status(proxy.run("rosproxy", "status", "--json", check=False)).domains
    except ValueError:
        return DomainStatus()
    return status


def ports_are_kept(proxy: Proxy, count: int) -> bool:
    """Whether a proxy has ``count`` participants inside that all keep their ports."""
    kept = [participant.kept for participant in domain(proxy).inside]
    return len(kept) == count and all(kept)


def leased(proxy: Proxy) -> dict[str, list[int]]:
    """The ports of the range that lead to participants inside, by GUID prefix."""
    return {
        participant.guid_prefix: sorted(lease.port for lease in participant.leases)
        for participant in domain(proxy).inside
    }
