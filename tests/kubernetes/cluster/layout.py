"""Addresses, names and files of the cluster."""

import os
from dataclasses import dataclass
from pathlib import Path

STATE = Path(os.environ.get("CLUSTER_DIR", "/var/lib/rosproxy-cluster"))
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
BIN = Path(os.environ.get("CLUSTER_BIN", CACHE / "rosproxy/cluster"))
KUBECONFIG = STATE / "admin.kubeconfig"
PKI = STATE / "pki"
LOGS = STATE / "logs"

BRIDGE = "rpxcluster"
GATEWAY = "10.88.0.1"
"""This machine on the bridge: the control plane."""
API_SERVER = f"https://{GATEWAY}:6443"
ROBOT_ADDRESS = "10.88.0.50"
ROBOT = "rosproxy-cluster-robot"
POD_NETWORK = "10.244.0.0/16"
SERVICE_NETWORK = "10.96.0.0/16"
API_SERVICE = "10.96.0.1"
CLUSTER_DOMAIN = "cluster.local"


@dataclass(frozen=True)
class Node:
    """A machine of the cluster: a network namespace with a kubelet and its companions."""

    number: int

    @property
    def name(self) -> str:
        return f"node{self.number}"

    @property
    def address(self) -> str:
        return f"10.88.0.1{self.number}"

    @property
    def pod_network(self) -> str:
        return f"10.244.{self.number}.0/24"

    @property
    def namespace(self) -> str:
        return f"rosproxy-{self.name}"

    @property
    def directory(self) -> Path:
        return STATE / self.name

    @property
    def socket(self) -> Path:
        """Of containerd."""
        return self.directory / "containerd.sock"

    @property
    def images(self) -> Path:
        """The file of the node's images: ids by name, as JSON."""
        return self.directory / "images.json"

    @property
    def kubeconfig(self) -> Path:
        return STATE / f"{self.name}.kubeconfig"


NODES = (Node(1), Node(2))


def node_named(name: str) -> Node:
    return next(node for node in NODES if node.name == name)
