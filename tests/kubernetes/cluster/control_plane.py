"""etcd, the API server, the controller manager and the scheduler."""

from pathlib import Path
from typing import Any

from tests.docker.engine import run, wait_until
from tests.kubernetes.cluster.certificates import certificate_file, key_file
from tests.kubernetes.cluster.layout import (
    BIN,
    GATEWAY,
    KUBECONFIG,
    PKI,
    SERVICE_NETWORK,
    STATE,
)
from tests.kubernetes.cluster.programs import Program

_ETCD = "http://127.0.0.1:22379"
_ETCD_PEERS = "http://127.0.0.1:22380"

ETCD = Program("etcd", (
    BIN / "etcd", f"--data-dir={STATE}/etcd", "--unsafe-no-fsync", "--log-level=warn",
    f"--listen-client-urls={_ETCD}", f"--advertise-client-urls={_ETCD}",
    f"--listen-peer-urls={_ETCD_PEERS}",
))  # fmt: skip
API_SERVER = Program("kube-apiserver", (
    BIN / "kube-apiserver",
    f"--etcd-servers={_ETCD}",
    f"--bind-address={GATEWAY}",
    f"--advertise-address={GATEWAY}",
    f"--service-cluster-ip-range={SERVICE_NETWORK}",
    f"--client-ca-file={certificate_file('ca')}",
    f"--tls-cert-file={certificate_file('apiserver')}",
    f"--tls-private-key-file={key_file('apiserver')}",
    f"--kubelet-client-certificate={certificate_file('admin')}",
    f"--kubelet-client-key={key_file('admin')}",
    f"--kubelet-certificate-authority={certificate_file('ca')}",
    "--kubelet-preferred-address-types=InternalIP",
    f"--service-account-key-file={PKI}/service-account.pub",
    f"--service-account-signing-key-file={key_file('service-account')}",
    "--service-account-issuer=https://kubernetes.default.svc",
    "--authorization-mode=Node,RBAC",
    "--enable-admission-plugins=NodeRestriction",
    "--allow-privileged",
))  # fmt: skip
# A lost node is noticed after 10 seconds here and not after 50, as the kubelets tell more often.
CONTROLLER_MANAGER = Program("kube-controller-manager", (
    BIN / "kube-controller-manager",
    f"--kubeconfig={STATE}/kube-controller-manager.kubeconfig",
    "--bind-address=127.0.0.1",
    f"--service-account-private-key-file={key_file('service-account')}",
    f"--root-ca-file={certificate_file('ca')}",
    "--use-service-account-credentials",
    "--leader-elect=false",
    "--node-monitor-period=1s",
    "--node-monitor-grace-period=10s",
))  # fmt: skip
SCHEDULER = Program("kube-scheduler", (
    BIN / "kube-scheduler",
    f"--kubeconfig={STATE}/kube-scheduler.kubeconfig",
    "--bind-address=127.0.0.1",
    "--leader-elect=false",
))  # fmt: skip
PROGRAMS = (ETCD, API_SERVER, CONTROLLER_MANAGER, SCHEDULER)


def kubectl(*arguments: str | Path, check: bool = True, seconds: float = 60, **options: Any) -> str:
    """Run kubectl as the cluster's administrator."""
    command = (BIN / "kubectl", f"--kubeconfig={KUBECONFIG}", *arguments)
    return run(*command, check=check, seconds=seconds, **options)


def start_control_plane() -> None:
    """Start the whole control plane, and wait for the API server."""
    for program in (ETCD, API_SERVER):
        program.start()
    wait_for_api_server()
    for program in (CONTROLLER_MANAGER, SCHEDULER):
        program.start()


def wait_for_api_server(seconds: float = 60) -> None:
    def ready() -> bool:
        for program in (ETCD, API_SERVER):
            assert program.pid is not None, f"{program.name} has ended:\n{program.last_words()}"
        return kubectl("get", "--raw", "/readyz", check=False) == "ok"

    wait_until(ready, seconds, API_SERVER.last_words)


def restart_api_server() -> None:
    """Kill and restart the API server. On SIGTERM it would hold its port for a minute."""
    API_SERVER.kill()
    API_SERVER.start()
    wait_for_api_server()


def stop_control_plane() -> None:
    for program in reversed(PROGRAMS):
        program.kill()
