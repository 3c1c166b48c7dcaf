"""The chart, installed with Helm as a user would."""

import json
import re
import shlex
import tempfile
import textwrap
from pathlib import Path
from typing import Any

from scripts.release_check import running_registry

from tests.docker.engine import ROOT, docker, run, wait_until
from tests.docker.images import OPERATOR, PROXY
from tests.kubernetes import api
from tests.kubernetes.api import Json
from tests.kubernetes.cluster.images import load_images
from tests.kubernetes.cluster.layout import BIN, KUBECONFIG
from tests.kubernetes.pods import Namespace, Pod

CHART = ROOT / "charts/rosproxy-operator"
NAMESPACE = "rosproxy-system"
NAME = "rosproxy"
FULL_NAME = "rosproxy-operator"
"""The chart's name of the release's objects."""
OPERATORS = "app.kubernetes.io/component=operator"
PROXIES = "app.kubernetes.io/component=proxy"
IMAGE_CHECKS = "app.kubernetes.io/component=image-check"
_OTHER = "rosproxy:other"
_IMAGES: Json = {
    "image": {"repository": "rosproxy-operator", "tag": "test", "pullPolicy": "Never"},
    "proxy": {"image": {"repository": "rosproxy", "tag": "test", "pullPolicy": "Never"}},
    "allow": {
        "dataPlanes": ["Auto", "Kernel", "Splice", "Copy"],
        "images": ["rosproxy:*"],
        "listen": ["NodePort"],
    },
    "crds": {"keep": False},
    "tests": {
        "image": "rosproxy-test-ros:latest",
        "imagePullPolicy": "Never",
        "namespace": "default",
    },
}


def helm(*arguments: str | Path, check: bool = True, seconds: float = 180) -> str:
    command = (BIN / "helm", f"--kubeconfig={KUBECONFIG}", *arguments)
    return run(*command, check=check, seconds=seconds)


def install() -> None:
    """Install the chart in a namespace that lets nothing run but what is *restricted*."""
    _create_namespace()
    _apply("install")


def install_former(chart: Path, tag: str) -> None:
    """Install a former chart in place of the release, with images of this tag."""
    remove()
    _create_namespace()
    images = {"image": {"tag": tag}, "proxy": {"image": {"tag": tag}}}
    # The former chart refuses values that came later.
    former = {key: value for key, value in _IMAGES.items() if key in ("image", "proxy", "tests")}
    _helm_with(_merged(former, images), "install", chart)


def _create_namespace() -> None:
    restricted = {"pod-security.kubernetes.io/enforce": "restricted"}
    api.create({"apiVersion": "v1", "kind": "Namespace",
                "metadata": {"name": NAMESPACE, "labels": restricted}})  # fmt: skip


def install_again(**values: Any) -> None:
    """Install the chart anew, with these additional values."""
    uninstall()
    _apply("install", **values)


def install_from_a_registry(directory: Path) -> None:
    """Install the chart from a registry, as users of a release do; the directory is empty."""
    helm("package", CHART, "--destination", directory)
    (package,) = directory.iterdir()
    with running_registry(directory) as address:
        helm("push", package, f"oci://{address}/charts", "--plain-http")
        version = package.stem.removeprefix(f"{CHART.name}-")
        chart = f"oci://{address}/charts/{CHART.name}"
        _helm_with(_IMAGES, "install", chart, "--version", version, "--plain-http",
                   "--create-namespace")  # fmt: skip


def install_as_the_readme_says(namespace: str, master: str) -> str:
    """Run the command of the chart's README in place of the release. Return the notes' RosProxy.

    The nodes have the images already. The operator manages ``namespace``, and allows ``master``.
    """
    remove()
    version = _app_version()
    for image in (OPERATOR, PROXY):
        name = f"{image.partition(':')[0]}:{version}"
        docker("tag", image, name)
        load_images(name)
    (command,) = re.findall(
        r"^helm (install .*?)\n```", (CHART / "README.md").read_text(), re.M | re.S
    )
    own = {
        "\\\n": "",
        "$REGISTRY/": "",
        "{robots}": f"{{{namespace}}}",
        str(CHART.relative_to(ROOT)): str(CHART),
    }
    for theirs, ours in own.items():
        assert theirs in command, command
        command = command.replace(theirs, ours)
    helm(*shlex.split(command), "--set", f"allow.masters={{{master}}}", seconds=360)
    notes = helm("get", "notes", NAME, "--namespace", NAMESPACE)
    (example,) = re.findall(
        rf"^  kubectl -n {namespace} apply -f - <<END\n(.*?)^  END$", notes, re.M | re.S
    )
    return textwrap.dedent(example)


def _app_version() -> str:
    (version,) = re.findall(r"^appVersion: (\S+)$", (CHART / "Chart.yaml").read_text(), re.M)
    return str(version)


def upgrade(**values: Any) -> None:
    """Upgrade the release, with these values in addition to the tests' values."""
    _apply("upgrade", **values)


def other_image() -> str:
    """The tag of another image of the proxy, which all nodes have: the same but for a label."""
    run("docker", "build", "--tag", _OTHER, "--label", "other=1", "-", input=f"FROM {PROXY}")
    load_images(_OTHER)
    return _OTHER.partition(":")[2]


def uninstall() -> None:
    """Uninstall the release, if there is one."""
    helm("uninstall", NAME, "--namespace", NAMESPACE, "--wait", "--ignore-not-found")


def remove() -> None:
    """Remove the release completely, in any state."""
    uninstall()
    api.delete("namespaces", "", NAMESPACE)
    wait_until(lambda: not api.get("namespaces", "", NAMESPACE), 60, f"{NAMESPACE} is gone")


def operators() -> list[Pod]:
    """The operators' pods, without pods that are being deleted."""
    bodies = api.objects("pods", NAMESPACE, OPERATORS)
    alive = [body["metadata"] for body in bodies if "deletionTimestamp" not in body["metadata"]]
    return [Pod(NAMESPACE, metadata["name"]) for metadata in alive]


def holder() -> str:
    """The holder of the Lease: the name of an operator's pod, and a part for the process."""
    return str(api.get("leases", NAMESPACE, FULL_NAME).get("spec", {}).get("holderIdentity", ""))


def operator() -> Pod:
    """The pod of the operator that leads."""
    leading: list[Pod] = []

    def has_leader() -> bool:
        leading[:] = [pod for pod in operators() if holder().startswith(f"{pod.name}_")]
        return bool(leading)

    wait_until(has_leader, 30, lambda: f"one leads: {holder()!r} of {operators()}")
    return leading[0]


def kill_operator() -> None:
    """Kill the process of the leading operator, and delete the pod.

    Without the deletion, the kubelet waits 10 s, 20 s, 40 s, … before the next start.
    """
    pod = operator()
    pod.crash()
    pod.remove(grace=0)


def wait_operator(seconds: float = 60, namespace: str = "default") -> None:
    """Wait until all operators are ready, one leads, and the webhook answers for a namespace.

    For a second after an operator is ready, kube-proxy still leads to the former operator.
    """
    wanted = api.get("deployments", NAMESPACE, FULL_NAME)["spec"]["replicas"]

    def is_serving() -> bool:
        bodies = api.objects("pods", NAMESPACE, OPERATORS)
        alive = operators()
        ready = len(bodies) == len(alive) == wanted and all(pod.ready for pod in alive)
        return ready and operator() in alive and _webhook_answers(namespace)

    wait_until(is_serving, seconds, lambda: str(api.objects("pods", NAMESPACE, OPERATORS)))


def _webhook_answers(namespace: str) -> bool:
    """Whether the webhook warns of a labelled pod without a RosProxy. True without a webhook."""
    if not api.get("mutatingwebhookconfigurations", "", FULL_NAME):
        return True
    body = Namespace(namespace).pod_body("unused", "true")
    return api.dry_run(body)[1] != ""


def _apply(verb: str, **values: Any) -> None:
    _helm_with(_merged(_IMAGES, values), verb, CHART)


def _helm_with(values: Json, verb: str, chart: str | Path, *options: str) -> None:
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        json.dump(values, file)
        file.flush()
        helm(verb, NAME, chart, *options, "--namespace", NAMESPACE,
             "--values", file.name, "--wait", "--timeout", "2m")  # fmt: skip


def _merged(values: Json, more: Json) -> Json:
    merged = dict(values)
    for name, value in more.items():
        both = isinstance(value, dict) and isinstance(merged.get(name), dict)
        merged[name] = _merged(merged[name], value) if both else value
    return merged
