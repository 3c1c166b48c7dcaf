"""Users' mistakes: each is reported where users look, and the reported fix works.

Each test makes a mistake, waits for the words, and follows the fix to the letter. Then the RosProxy
is ready, the proxy reaches the master, and the doctor finds no error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from tests.docker.engine import wait_until
from tests.docker.nodes import node_command
from tests.kubernetes import api
from tests.kubernetes.api import Json
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.cluster.layout import NODES, ROBOT_ADDRESS
from tests.kubernetes.cluster.network import inside
from tests.kubernetes.pods import INJECT, Namespace
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import RosProxy, events, rosproxy
from tests.kubernetes.test_doctor import doctor

APP = "app"
TOLD_WITHIN = 100.0
"""Seconds until a mistake must be told: a pod without a RosProxy is told after a minute."""


@dataclass(frozen=True)
class Site:
    """A namespace with a Deployment ``app`` and a RosProxy ``robot``, and the robot outside."""

    net: Namespace
    robot: Robot

    @property
    def rosproxy(self) -> RosProxy:
        return RosProxy(self.net.name, "robot")

    def create_rosproxy(self, **spec: Any) -> None:
        ros2 = str(spec.get("ros")) == "2"
        master = {} if ros2 else {"master": {"uri": self.robot.master_uri}}
        rosproxy(self.net.name, **{**master, "ports": 8, **spec})

    def create_app(self, **template: Any) -> None:
        """Create the Deployment. ``template`` are properties of the pods besides the label."""
        labels = {"app": APP, **template.pop("labels", {INJECT: "true"})}
        metadata = {"labels": labels, "annotations": template.pop("annotations", {})}
        command = template.pop("command", ("sleep", "infinity"))
        spec = self.net.pod_body("unused", *command, **template)["spec"]
        body = {
            "apiVersion": "apps/v1", "kind": "Deployment",
            "metadata": {"name": APP, "namespace": self.net.name},
            "spec": {"replicas": 1, "selector": {"matchLabels": {"app": APP}},
                     "template": {"metadata": metadata, "spec": spec}},
        }  # fmt: skip
        api.create(body)

    def edit_app(
        self, labels: Json | None = None, annotations: Json | None = None, **spec: Any
    ) -> None:
        """Change the template of the pods; None takes a label, annotation or field out."""
        metadata = {"labels": labels or {}, "annotations": annotations or {}}
        template = {"metadata": metadata, "spec": spec}
        api.patch("deployments", self.net.name, APP, {"spec": {"template": template}})

    def restart_app(self) -> None:
        kubectl("-n", self.net.name, "rollout", "restart", f"deployment/{APP}")

    def create(self, kind: str, name: str, **spec: Any) -> None:
        metadata = {"name": name, "namespace": self.net.name}
        api.create({"apiVersion": "v1", "kind": kind, "metadata": metadata, "spec": spec})

    def texts(self, reason: str) -> list[str]:
        """The texts with this reason, in Events of pods and RosProxies, and in conditions."""
        conditions = self.rosproxy.status.get("conditions", [])
        own = self.rosproxy.events
        pods = [
            event
            for pod in self.net.pods()
            for event in events(self.net.name, pod["metadata"]["name"], "Pod")
        ]
        return [
            *(c["message"] for c in conditions if c.get("reason") == reason),
            *(event.message for event in (*own, *pods) if event.reason == reason),
        ]

    def is_well(self) -> bool:
        status = self.rosproxy.status
        now = {c["type"]: c["status"] for c in status.get("conditions", [])}
        wanted = {"Ready": "True", "Degraded": "False"}
        return status.get("nodes") == 1 and wanted.items() <= now.items()


Step = Callable[[Site], None]


@dataclass(frozen=True)
class Mistake:
    """A mistake, the reported reason and words, and the fix.

    ``undo`` removes remainders outside of the namespace.
    """

    make: Step
    reason: str
    words: str
    fix: Step
    undo: Step = lambda _: None


def _both(spec: dict[str, Any], template: dict[str, Any]) -> Step:
    def make(site: Site) -> None:
        site.create_rosproxy(**spec)
        site.create_app(**template)

    return make


def _spec(**spec: Any) -> Step:
    """A wrong RosProxy, with a right Deployment."""
    return _both(spec, {})


def _template(**template: Any) -> Step:
    """A wrong Deployment, with a right RosProxy."""
    return _both({}, template)


def _change(**spec: Any) -> Step:
    return lambda site: site.rosproxy.change(**spec)


def _relabel(value: str | None, **labels: Any) -> Step:
    return lambda site: site.edit_app({INJECT: value, **labels})


def _set_master(site: Site) -> None:
    site.rosproxy.change(master={"uri": site.robot.master_uri, "service": None})


def _without_variables(site: Site) -> None:
    containers = site.net.pod_body("unused", "sleep", "infinity")["spec"]["containers"]
    site.edit_app(containers=containers)


def _late_rosproxy(site: Site) -> None:
    site.create_app()
    wait_until(lambda: bool(site.net.pods(f"app={APP}")), 60, "the pod")
    site.create_rosproxy()


def _rosproxy_and_restart(site: Site) -> None:
    site.create_rosproxy()
    site.restart_app()


def _two(site: Site) -> None:
    site.create_rosproxy()
    rosproxy(site.net.name, "second", master={"uri": site.robot.master_uri}, ports=8)
    site.create_app()


def _unknown_name(site: Site) -> None:
    port = site.robot.port
    site.create_rosproxy(master={"uri": f"http://robott:{port}"})
    site.create_app()


def _set_address(site: Site) -> None:
    host = site.robot.master_uri.removeprefix("http://").partition(":")[0]
    site.rosproxy.change(master={"address": host})


def _right_selector(site: Site) -> None:
    site.rosproxy.change(podSelector={"matchLabels": {"app": APP}})
    site.restart_app()


def _namesake(site: Site) -> None:
    site.create("Service", "rosproxy-robot", ports=[{"port": 80}])
    site.create_rosproxy()
    site.create_app()


def _no_namesake(site: Site) -> None:
    api.delete("services", site.net.name, "rosproxy-robot")
    restart_as_told(site)


def _allowed_image(site: Site) -> None:
    site.rosproxy.change(image=None)
    restart_as_told(site)


def restart_as_told(site: Site) -> None:
    """Restart pods that were created before the RosProxy's Service, once the finding is
    reported.
    """
    command = f"rollout restart deployment/{APP}"
    wait_until(
        lambda: any(command in text for text in site.texts("NotWired")), 60, "a restart is the fix"
    )
    site.restart_app()


def _quota(**hard: str) -> Step:
    def make(site: Site) -> None:
        site.create("ResourceQuota", "small", hard=hard)
        site.create_rosproxy()
        site.create_app()

    return make


def _more_pods(site: Site) -> None:
    api.patch("resourcequotas", site.net.name, "small", {"spec": {"hard": {"pods": "8"}}})


def _quota_of_cpu(site: Site) -> None:
    site.create("ResourceQuota", "cpu", hard={"limits.cpu": "4"})
    site.create_rosproxy()
    site.create_app()
    containers = site.net.pod_body("unused", "sleep", "infinity")["spec"]["containers"]
    site.edit_app(containers=[{**containers[0], "resources": {"limits": {"cpu": "100m"}}}])


def _limit_range(site: Site) -> None:
    site.create("LimitRange", "small", limits=[{"type": "Container", "max": {"memory": "256Mi"}}])
    site.create_rosproxy()
    site.create_app()


def _pod_security(site: Site) -> None:
    level = {"pod-security.kubernetes.io/enforce": "baseline"}
    api.patch("namespaces", "", site.net.name, {"metadata": {"labels": level}})
    site.create_rosproxy()
    site.create_app()


def _privileged(site: Site) -> None:
    label = "pod-security.kubernetes.io/enforce=privileged"
    kubectl("label", "namespace", site.net.name, label, "--overwrite")


def _astray_alone(site: Site) -> None:
    site.create_app(labels={"rosproxy.io/injekt": "true"})


def _label_and_rosproxy(site: Site) -> None:
    site.create_rosproxy()
    site.edit_app({INJECT: "true", "rosproxy.io/injekt": None})


def _made_anew(site: Site) -> None:
    site.create_rosproxy()
    site.create_app()
    wait_until(site.is_well, 90, site.rosproxy.tell)
    site.rosproxy.remove()
    wait_until(lambda: not site.rosproxy.body, 60, "the RosProxy is gone")
    site.create_rosproxy()


TWO_NODES = " & exec ".join(
    " ".join(node_command("rospy", "pub", "--topic", f"/few_{name}", f"__name:=few_{name}"))
    for name in ("one", "two")
)


def _taint(site: Site) -> None:
    kubectl("taint", "node", "node2", "robots=only:NoSchedule")
    site.create_rosproxy()
    toleration = {"key": "robots", "operator": "Exists"}
    site.create_app(on="node2", tolerations=[toleration])


def _untaint(_: Site) -> None:
    kubectl("taint", "node", "node2", "robots-", check=False)


def _rule(site: Site) -> tuple[str, ...]:
    port = str(site.robot.port)
    return ("FORWARD", "-d", ROBOT_ADDRESS, "-p", "tcp", "--dport", port, "-j", "DROP")


def _block_master(site: Site) -> None:
    for node in NODES:
        inside(node, "iptables", "-w", "-I", *_rule(site))
    site.create_rosproxy()
    site.create_app()


def _open_master(site: Site) -> None:
    for node in NODES:
        inside(node, "sh", "-c", f"while iptables -w -D {' '.join(_rule(site))}; do :; done 2>&1")


def _master_service(site: Site, **spec: Any) -> None:
    """Create a Service at port 11400 for the master on the robot, like many sites."""
    port = {"port": 11400, "targetPort": site.robot.port}
    site.create("Service", "master", ports=[port], **spec)
    ports = [{"port": site.robot.port}]
    subsets = [{"addresses": [{"ip": ROBOT_ADDRESS}], "ports": ports}]
    metadata = {"name": "master", "namespace": site.net.name}
    api.create({"apiVersion": "v1", "kind": "Endpoints", "metadata": metadata, "subsets": subsets})


def _other_port(site: Site) -> None:
    _master_service(site)
    site.create_rosproxy(master={"service": {"name": "master"}})
    site.create_app()


def _headless(site: Site) -> None:
    _master_service(site, clusterIP="None")
    site.create_rosproxy(master={"service": {"name": "master", "port": 11400}})
    site.create_app()


def _with_an_address(site: Site) -> None:
    for resource in ("services", "endpoints"):
        api.delete(resource, site.net.name, "master")
    wait_until(lambda: not api.get("endpoints", site.net.name, "master"), 30, "both are gone")
    _master_service(site)


IMAGE = {"image": "rosproxy:typo", "imagePullPolicy": "Never"}
MISTAKES: dict[str, Mistake] = {
    "key of the label": Mistake(
        _template(labels={"rosproxy.io/injekt": "true"}),
        "UnknownName", "Did you mean the label rosproxy.io/inject",
        _relabel("true", **{"rosproxy.io/injekt": None}),
    ),
    "key of the label, and no RosProxy": Mistake(
        _astray_alone, "UnknownName", "Did you mean the label rosproxy.io/inject",
        _label_and_rosproxy,
    ),
    "annotation instead of the label": Mistake(
        _template(labels={}, annotations={INJECT: "true"}),
        "UnknownName", "The operator reads only the label rosproxy.io/inject",
        lambda site: site.edit_app({INJECT: "true"}, {INJECT: None}),
    ),
    "True with a capital": Mistake(
        _template(labels={INJECT: "True"}), "NotWired", "true in lower case", _relabel("true")
    ),
    "label names no RosProxy": Mistake(
        _template(labels={INJECT: "robott"}), "NotWired", "Set the label to robot",
        _relabel("robot"),
    ),
    "no RosProxy": Mistake(
        lambda site: site.create_app(), "NotWired", "RosProxy", _rosproxy_and_restart
    ),
    "RosProxy after the pod": Mistake(
        _late_rosproxy, "NotWired", f"rollout restart deployment/{APP}", Site.restart_app
    ),
    "RosProxy deleted and created again": Mistake(
        _made_anew, "NotWired", f"rollout restart deployment/{APP}", Site.restart_app
    ),
    "two RosProxies": Mistake(_two, "Ambiguous", INJECT, _relabel("robot")),
    "another master in the template": Mistake(
        _template(env={"ROS_MASTER_URI": "http://192.0.2.7:11311"}),
        "NotWired", "Remove the variable from the template", _without_variables,
    ),
    "hostNetwork": Mistake(
        _template(hostNetwork=True), "HostNetwork", "hostNetwork",
        lambda site: site.edit_app(hostNetwork=None),
    ),
    "labels of the selector": Mistake(
        _both({"podSelector": {"matchLabels": {"app": "other"}}}, {}),
        "NotWired", "do not match spec.podSelector",
        _right_selector,
    ),
    "pods without the label": Mistake(
        _both({"podSelector": {"matchLabels": {"app": APP}}}, {"labels": {}}),
        "NotWired", "Add the label", _relabel("true"),
    ),
    "master refuses": Mistake(
        _spec(master={"uri": "http://10.88.0.50:1"}), "MasterUnreachable", "correct spec.master",
        _set_master,
    ),
    "firewall before the master": Mistake(
        _block_master, "MasterUnreachable", "allow connections from pods", _open_master,
        _open_master,
    ),
    "name of the master": Mistake(
        _unknown_name, "MasterUnreachable", "set spec.master.address", _set_address
    ),
    "Service of the master": Mistake(
        _spec(master={"service": {"name": "roscore"}}), "MasterUnknown",
        "does not exist. Create the Service", lambda site: site.rosproxy.change(
            master={"service": None, "uri": site.robot.master_uri}),
    ),
    "port of the master's Service": Mistake(
        _other_port, "MasterUnknown", "its ports: 11400). Set spec.master.service.port",
        _change(master={"service": {"name": "master", "port": 11400}}),
    ),
    "headless Service of the master": Mistake(
        _headless, "MasterUnknown", "create it without clusterIP: None", _with_an_address
    ),
    "fewer ports than ROS nodes": Mistake(
        _both({"ports": 1}, {"command": ("sh", "-c", TWO_NODES)}), "ProxyWarns",
        "et a larger spec.ports", _change(ports=8),
    ),
    "image": Mistake(
        _spec(**IMAGE), "ProxyStuck", "set spec.image",
        _change(image=None, imagePullPolicy=None),
    ),
    "image that is not allowed": Mistake(
        _spec(image="example.org/other:1"), "NotAllowed", "Remove the field",
        _allowed_image,
    ),
    "no node fits": Mistake(
        _spec(nodeSelector={"kubernetes.io/hostname": "nowhere"}), "NodeLeftOut",
        "spec.nodeSelector", _change(nodeSelector=None),
    ),
    "taint of the node": Mistake(
        _taint, "ProxyStuck", "Set spec.tolerations as in your pods",
        _change(tolerations=[{"key": "robots", "operator": "Exists"}]), _untaint,
    ),
    "more memory than a node has": Mistake(
        _spec(resources={"requests": {"memory": "4Ti"}, "limits": {"memory": "4Ti"}}), "ProxyStuck",
        "spec.resources", _change(resources=None),
    ),
    "no external address": Mistake(
        _spec(advertise="ExternalIP"), "NoAdvertiseHost", "spec.advertise",
        _change(advertise="InternalIP"),
    ),
    "name that outside does not know": Mistake(
        _spec(advertise="Hostname"), "ProxyWarns", "et spec.advertise",
        _change(advertise="InternalIP"),
    ),
    "ports of NodePorts": Mistake(
        _spec(portWindow={"first": 30000, "last": 30100}), "PortsExhausted", "spec.portWindow",
        _change(portWindow=None),
    ),
    "name is taken": Mistake(_namesake, "ProxyNotAdmitted", "Delete that object", _no_namesake),
    "quota of pods": Mistake(
        _quota(pods="1"), "ProxyNotAdmitted", "ResourceQuota", _more_pods
    ),
    "quota that wants limits": Mistake(
        _quota_of_cpu, "ProxyNotAdmitted", "spec.resources",
        _change(resources={"limits": {"cpu": "200m", "memory": "256Mi"}}),
    ),
    "LimitRange": Mistake(
        _limit_range, "ProxyNotAdmitted", "LimitRange",
        _change(resources={"limits": {"memory": "256Mi"}, "requests": {"memory": "64Mi"}}),
    ),
    "Pod Security": Mistake(
        _pod_security, "ProxyNotAdmitted", "kubectl label namespace", _privileged
    ),
    "domain in the template": Mistake(
        _both({"ros": 2, "domain": 3, "master": None}, {"env": {"ROS_DOMAIN_ID": "7"}}),
        "OtherDomain", "ROS_DOMAIN_ID", _without_variables,
    ),
    "localhost only": Mistake(
        _both({"ros": 2, "master": None}, {"env": {"ROS_LOCALHOST_ONLY": "1"}}),
        "Alone", "ROS_LOCALHOST_ONLY", _without_variables,
    ),
    "peers in the template": Mistake(
        _both({"ros": 2, "master": None}, {"env": {"ROS_STATIC_PEERS": "192.0.2.7"}}),
        "NotWired", "ROS_STATIC_PEERS", _without_variables,
    ),
}  # fmt: skip


@pytest.fixture
def site(net: Namespace, robot: Robot) -> Site:
    return Site(net, robot)


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_told_and_the_fix_works(name: str, site: Site) -> None:
    mistake = MISTAKES[name]
    try:
        mistake.make(site)
        told = _wait_told(site, mistake)
        code, found = doctor(site.net.name)
        assert code == 1, found
        mistake.fix(site)
        wait_until(site.is_well, 90, lambda: f"the fix works: {told()}")
    finally:
        mistake.undo(site)
    wrong = [finding for finding in doctor(site.net.name)[1] if finding["severity"] == "error"]
    # The doctors of ROS 2 proxies miss participants: the pods run no nodes.
    assert not [finding for finding in wrong if not finding["subject"].startswith("proxy ")], wrong


def _wait_told(site: Site, mistake: Mistake) -> Callable[[], str]:
    """Wait until a mistake is told; return what tells the story of a failure."""

    def is_told() -> bool:
        return any(mistake.words in text for text in site.texts(mistake.reason))

    def story() -> str:
        return f"{mistake.reason}: {site.texts(mistake.reason)}\n{site.rosproxy.tell()}"

    wait_until(is_told, TOLD_WITHIN, lambda: f"{mistake.words!r} is told: {story()}")
    return story
