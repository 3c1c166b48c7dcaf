"""A node: containerd, kubelet and kube-proxy in a network namespace."""

import json
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.docker.engine import run, wait_until
from tests.kubernetes.cluster import cgroups, mounts
from tests.kubernetes.cluster.certificates import certificate_file, key_file
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.cluster.layout import (
    BIN,
    CLUSTER_DOMAIN,
    GATEWAY,
    POD_NETWORK,
    STATE,
    Node,
)
from tests.kubernetes.cluster.network import plug_in_node, unplug_node
from tests.kubernetes.cluster.programs import Program, command_line, kill, processes

PAUSE_IMAGE = "localhost/pause:3.10"
_CNI_PROGRAMS = "/usr/lib/cni"

_CONTAINERD = """\
version = 2
root = "{directory}/containerd"
state = "{directory}/containerd-state"
oom_score = 0
disabled_plugins = ["io.containerd.internal.v1.opt", "io.containerd.internal.v1.tracing"]
[grpc]
address = "{socket}"
[plugins."io.containerd.grpc.v1.cri"]
sandbox_image = "{pause}"
disable_apparmor = true
# Without CAP_SYS_RESOURCE every sandbox fails with "can't get final child's PID from pipe".
restrict_oom_score_adj = true
netns_mounts_under_state_dir = true
[plugins."io.containerd.grpc.v1.cri".cni]
bin_dir = "{cni}"
conf_dir = "{directory}/cni"
"""


def containerd(node: Node) -> Program:
    config = node.directory / "containerd.toml"
    return Program(f"{node.name}-containerd", ("containerd", "--config", config), node.namespace)


def kubelet(node: Node) -> Program:
    return Program(f"{node.name}-kubelet", (
        BIN / "kubelet",
        f"--kubeconfig={node.kubeconfig}",
        f"--config={node.directory}/kubelet.json",
        f"--hostname-override={node.name}",
        f"--node-ip={node.address}",
        f"--root-dir={node.directory}/kubelet",
        f"--cert-dir={node.directory}/kubelet-pki",
    ), node.namespace)  # fmt: skip


def kube_proxy(node: Node) -> Program:
    return Program(f"{node.name}-kube-proxy", (
        BIN / "kube-proxy",
        f"--kubeconfig={STATE}/kube-proxy.kubeconfig",
        f"--hostname-override={node.name}",
        "--proxy-mode=iptables",
        f"--cluster-cidr={POD_NETWORK}",
        "--conntrack-max-per-core=0",
        "--oom-score-adj=0",
    ), node.namespace)  # fmt: skip


def start_containerd(node: Node) -> None:
    """Plug a node in and start its containerd, ready to load images."""
    node.directory.mkdir(parents=True, exist_ok=True)
    _write_configuration(node)
    plug_in_node(node)
    program = containerd(node)
    program.start()
    wait_until(
        lambda: "Server:" in run("ctr", "-a", node.socket, "version", check=False),
        30, program.last_words,
    )  # fmt: skip


def join(node: Node) -> None:
    """Join a node to the cluster, whose API server must be up."""
    body = {
        "apiVersion": "v1", "kind": "Node", "metadata": {"name": node.name},
        "spec": {"podCIDR": node.pod_network, "podCIDRs": [node.pod_network]},
    }  # fmt: skip
    if kubectl("get", "node", node.name, "--ignore-not-found", "--output=name") == "":
        manifest = node.directory / "node.json"
        manifest.write_text(json.dumps(body))
        kubectl("create", "--filename", manifest)
    cgroups.make(node.name)
    for program in (kubelet(node), kube_proxy(node)):
        program.start()


def wait_until_ready(node: Node, seconds: float = 60) -> None:
    """Wait until a node takes pods: ready and without taints."""
    kubectl("wait", f"node/{node.name}", "--for=condition=Ready", f"--timeout={seconds:.0f}s",
            seconds=seconds + 10)  # fmt: skip
    wait_until(lambda: not _taints(node),
               seconds, lambda: _taints(node))  # fmt: skip


def stop_node(node: Node) -> None:
    """Pull the plug of a node: everything stops at once without notice. The disk stays."""
    for program in (kubelet(node), kube_proxy(node), containerd(node)):
        program.kill()
    kill(_shims(node))
    cgroups.empty(node.name)
    unplug_node(node)
    mounts.unmount_below(node.directory)
    run("rm", "-rf", node.directory / "containerd-state", node.socket)


def remove_node(node: Node) -> None:
    stop_node(node)
    cgroups.remove(node.name)
    for left in Path("/var/lib/cni/results").glob(f"{_cni_name(node)}-*"):
        left.unlink()


def _taints(node: Node) -> str:
    return kubectl("get", "node", node.name, "--output=jsonpath={.spec.taints[*].key}")


def _shims(node: Node) -> list[int]:
    """The processes that stand between containerd and the containers of a node."""
    mark = f"\0-address\0{node.socket}\0".encode()
    return [pid for pid in processes() if mark in command_line(pid)]


def _cni_name(node: Node) -> str:
    return f"rosproxy-{node.name}"


def _write_configuration(node: Node) -> None:
    text = _CONTAINERD.format(
        directory=node.directory, socket=node.socket, pause=PAUSE_IMAGE, cni=_CNI_PROGRAMS
    )
    (node.directory / "containerd.toml").write_text(text)
    (node.directory / "kubelet.json").write_text(json.dumps(_kubelet_configuration(node), indent=1))
    (node.directory / "cni").mkdir(exist_ok=True)
    plug_in_pods(node, _cni_configuration(node))


def plug_in_pods(node: Node, configuration: dict[str, Any]) -> None:
    """Set how new pods of a node are plugged in. containerd notices the change at once."""
    path = node.directory / "cni/rosproxy.conflist"
    new = path.with_suffix(".new")  # a name that containerd does not read
    new.write_text(json.dumps(configuration, indent=1))
    new.rename(path)


@contextmanager
def without_host_ports(node: Node) -> Iterator[None]:
    """Meanwhile no hostPort of a new pod is mapped, as where a network plug-in knows none."""
    whole = _cni_configuration(node)
    plug_in_pods(node, {**whole, "plugins": whole["plugins"][:1]})
    try:
        yield
    finally:
        plug_in_pods(node, whole)


def _kubelet_configuration(node: Node) -> dict[str, object]:
    return {
        "apiVersion": "kubelet.config.k8s.io/v1beta1",
        "kind": "KubeletConfiguration",
        "authentication": {"anonymous": {"enabled": False}, "webhook": {"enabled": True},
                           "x509": {"clientCAFile": str(certificate_file("ca"))}},
        "authorization": {"mode": "Webhook"},
        "tlsCertFile": str(certificate_file(node.name)),
        "tlsPrivateKeyFile": str(key_file(node.name)),
        "containerRuntimeEndpoint": f"unix://{node.socket}",
        "cgroupDriver": "cgroupfs",
        "cgroupRoot": f"/{node.name}",
        "failCgroupV1": False,
        "failSwapOn": False,
        "evictionHard": {},
        "localStorageCapacityIsolation": False,
        "imageGCHighThresholdPercent": 100,
        "podLogsDir": f"{node.directory}/pod-logs",
        "volumePluginDir": f"{node.directory}/volume-plugins",
        "resolvConf": "",  # no name server is in reach: names must fail at once
        # A test may run a name server there (`names.cluster_dns`). Without one, the control plane's
        # machine refuses each query at once.
        "clusterDNS": [GATEWAY],
        "clusterDomain": CLUSTER_DOMAIN,
        "oomScoreAdj": 0,
        "nodeStatusUpdateFrequency": "2s",
        "nodeLeaseDurationSeconds": 8,
    }  # fmt: skip


def _cni_configuration(node: Node) -> dict[str, Any]:
    """The CNI plug-in of pods: `ptp`, because Services that lead back to a node fail with
    `bridge`.
    """
    ipam = {
        "type": "host-local",
        "dataDir": f"{node.directory}/cni-addresses",
        "ranges": [[{"subnet": node.pod_network}]],
        "routes": [{"dst": "0.0.0.0/0"}],
    }
    return {
        "cniVersion": "0.4.0",
        "name": _cni_name(node),
        "plugins": [
            {"type": "ptp", "ipam": ipam},
            {"type": "portmap", "capabilities": {"portMappings": True}, "snat": True},
        ],
    }


def crash_container(node: Node, container: str) -> None:
    """Kill the first process of a container from behind, as the kernel would for want of memory."""
    kill(_first_processes(node, container))


def stop_container(node: Node, container: str) -> None:
    """Let the first process of a container hang."""
    for pid in _first_processes(node, container):
        os.kill(pid, signal.SIGSTOP)


def _first_processes(node: Node, container: str) -> list[int]:
    """The first process of a container, if the container runs."""
    lines = run("ctr", "-a", node.socket, "-n", "k8s.io", "tasks", "ls").splitlines()
    return [int(line.split()[1]) for line in lines if line.startswith(f"{container} ")]
