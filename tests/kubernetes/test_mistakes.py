"""Users' mistakes: the doctor names each mistake, and the doctor's fix works to the letter.

Each test makes a mistake, waits until an error of the doctor has the words about this mistake and
the fix, and follows the fix. If the doctor names a command, the test runs the command from the
output. Before, no message flows, with few exceptions. Then the RosProxy is ready, the doctor has no
error, and messages flow.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from tests.docker.engine import ROOT, wait_until
from tests.kubernetes import api
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.cluster.layout import NODES, ROBOT_ADDRESS, node_named
from tests.kubernetes.cluster.network import inside
from tests.kubernetes.mistakes import (
    APP,
    EDIT_ROSPROXY,
    Cure,
    Follow,
    Mistake,
    Site,
    Step,
    by_hand,
    edit_rosproxy,
    edit_template,
    errors,
    restart,
    run_told,
    walk_through,
)
from tests.kubernetes.pods import INJECT, Namespace
from tests.kubernetes.robot import Robot, robot_with_master
from tests.kubernetes.ros2 import ADDRESS, Robot2, robot_with_ros2
from tests.kubernetes.rosproxies import rosproxy
from tests.kubernetes.traffic import START, wait_for_service

OF_ROS2 = {"ros": 2, "peers": [ADDRESS], "ports": 16}


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


def _relabel(value: str, **labels: Any) -> Follow:
    return edit_template({INJECT: value, **labels})


def _set_master(site: Site, said: str) -> None:
    master = {"uri": site.robot.master_uri, "service": None}
    run_told(site, said, EDIT_ROSPROXY, {"spec": {"master": master}})


def _without_variables(site: Site, said: str) -> None:
    edit_template(containers=site.pod_spec()["containers"])(site, said)


def _late_rosproxy(site: Site) -> None:
    site.create_app()
    wait_until(lambda: bool(site.net.pods(f"app={APP}")), 60, "the pod")
    # Kubernetes counts whole seconds.
    (pod,) = site.net.pods(f"app={APP}")
    created = datetime.fromisoformat(pod["metadata"]["creationTimestamp"])
    wait_until(lambda: datetime.now(UTC) - created > timedelta(seconds=1), 5, "the next second")
    site.create_rosproxy()


def _create_and_restart(site: Site, said: str) -> None:
    site.create_rosproxy()
    restart(site, said)


def _two(site: Site) -> None:
    site.create_rosproxy()
    rosproxy(site.net.name, "second", master={"uri": site.robot.master_uri}, ports=8)
    site.create_app()


def _apply_example(site: Site, name: str) -> None:
    """Apply the guide's RosProxy of this name, in the namespace and with the master of the test."""
    guide = (ROOT / "docs/guide/kubernetes.md").read_text()
    examples = re.findall(r"^kubectl apply -f - <<END\n(.*?)^END$", guide, re.DOTALL | re.MULTILINE)
    (example,) = [text for text in examples if re.search(rf"^  name: {name}\b", text, re.MULTILINE)]
    example = example.replace("namespace: robots", f"namespace: {site.net.name}")
    example = re.sub(r"uri: http://\S+", f"uri: {site.robot.master_uri}", example)
    kubectl("apply", "-f", "-", input=example)


def _both_examples(site: Site) -> None:
    """Apply the guide's example for ROS 2 while pods use the example for ROS 1."""
    _apply_example(site, "robot")
    site.create_app()
    wait_until(site.is_well, 90, site.rosproxy.tell)
    wait_until(lambda: site.robot.knows_proxied(site.node), START, "the ROS node is registered")
    _apply_example(site, "robot2")


def _relabel_registered(site: Site, said: str) -> None:
    """The running pod stays with its proxy until the user changes the label."""
    assert site.robot.knows_proxied(site.node)
    _relabel("robot")(site, said)


def _unknown_name(site: Site) -> None:
    site.create_rosproxy(master={"uri": f"http://robott:{site.robot.port}"})
    site.create_app()


def _right_selector(site: Site, said: str) -> None:
    selector = {"matchLabels": {"app": APP}}
    run_told(site, said, EDIT_ROSPROXY, {"spec": {"podSelector": selector}})
    restart(site, said)


def _namesake(site: Site) -> None:
    site.create("Service", "rosproxy-robot", ports=[{"port": 80}])
    site.create_rosproxy()
    site.create_app()


def _no_namesake(site: Site) -> None:
    api.delete("services", site.net.name, "rosproxy-robot")


def _quota_of_pods(site: Site) -> None:
    site.create("ResourceQuota", "small", hard={"pods": "1"})
    site.create_rosproxy()
    site.create_app()


def _more_pods(site: Site) -> None:
    api.patch("resourcequotas", site.net.name, "small", {"spec": {"hard": {"pods": "8"}}})


def _quota_of_cpu(site: Site) -> None:
    site.create("ResourceQuota", "cpu", hard={"limits.cpu": "4"})
    site.create_rosproxy()
    site.create_app()
    (container,) = site.pod_spec()["containers"]
    site.edit_app(containers=[{**container, "resources": {"limits": {"cpu": "500m"}}}])


def _limit_range(site: Site) -> None:
    site.create("LimitRange", "small", limits=[{"type": "Container", "max": {"memory": "256Mi"}}])
    site.create_rosproxy()
    site.create_app()


def _pod_security(site: Site) -> None:
    level = {"pod-security.kubernetes.io/enforce": "baseline"}
    api.patch("namespaces", "", site.net.name, {"metadata": {"labels": level}})
    site.create_rosproxy()
    site.create_app()


def _privileged(site: Site, said: str) -> None:
    run_told(site, said, r"label namespace \S+ pod-security\S+ --overwrite")


def _two_nodes_for_a_port(site: Site) -> None:
    site.create_rosproxy(ports=1)
    nodes = [" ".join(site.talker(word, f"{site.node}_{word}")) for word in ("one", "two")]
    site.create_app(command=("sh", "-c", " & exec ".join(nodes)))


def _more_ports(site: Site, said: str) -> None:
    """ROS 1 nodes register only at their start, also the node that got no port."""
    assert "Then restart the ROS 1 nodes that got no port" in said
    edit_rosproxy(ports=8)(site, said)
    wait_until(site.is_well, 90, site.rosproxy.tell)
    site.restart_app()


def _name_of_the_node(site: Site) -> None:
    site.create_rosproxy(advertise="Hostname")
    site.create_app()
    wait_until(lambda: bool(site.robot.uri(site.node)), START, site.rosproxy.tell)


def _other_domain(former: dict[str, Any]) -> Step:
    """Change the domain of a RosProxy to 4, while the pod is in another domain."""

    def make(site: Site) -> None:
        site.create_rosproxy(**OF_ROS2, **former)
        wait_for_service(site.net)
        site.create_app()
        wait_until(site.is_well, 90, site.rosproxy.tell)
        site.rosproxy.change(domain=4)

    return make


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


OCCUPIED = {"first": 12600, "last": 12607}
KUBELET = "10250"
"""The port of a program that listens on each node."""


def _redirect() -> tuple[str, ...]:
    ports = f"{OCCUPIED['first']}:{OCCUPIED['last']}"
    return ("PREROUTING", "-d", node_named("node1").address, "-p", "tcp", "--dport", ports,
            "-j", "REDIRECT", "--to-ports", KUBELET)  # fmt: skip


def _program_at_the_ports(site: Site) -> None:
    """Another program gets the connections to the hostPorts of the proxy.

    A rule before those of portmap leads to this program, like the rules of Docker on a node.
    """
    inside(node_named("node1"), "iptables", "-w", "-t", "nat", "-I", *_redirect())
    site.create_rosproxy(portWindow=OCCUPIED)
    site.create_app(on="node1")
    site.rosproxy.wait_status(lambda s: s.get("rosNodes") == 1, "the ROS node is counted", START)


def _end_program(_: Site) -> None:
    rule = " ".join(_redirect())
    loop = f"while iptables -w -t nat -D {rule}; do :; done 2>&1"
    inside(node_named("node1"), "sh", "-c", loop)


def _other_window(site: Site) -> None:
    site.rosproxy.change(portWindow={"first": 12620, "last": 12640})


def _master_service(site: Site, name: str = "master", **spec: Any) -> None:
    """Create a Service at port 11400 for the master on the robot, like many sites."""
    port = {"port": 11400, "targetPort": site.robot.port}
    site.create("Service", name, ports=[port], **spec)
    ports = [{"port": site.robot.port}]
    subsets = [{"addresses": [{"ip": ROBOT_ADDRESS}], "ports": ports}]
    metadata = {"name": name, "namespace": site.net.name}
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
ASTRAY = "label rosproxy.io/injekt is unknown and ignored"
RESTART_THE_POD = Cure(
    "is older than Service rosproxy-robot of the RosProxy", "Run kubectl", restart
)
MISTAKES: dict[str, Mistake] = {
    "key of the label": Mistake(
        _template(labels={"rosproxy.io/injekt": "true"}), "UnknownName",
        (Cure(f"{ASTRAY}. Did you mean the label {INJECT}", "orrect the name in the template",
              _relabel("true", **{"rosproxy.io/injekt": None})),),
    ),
    "key of the label, and no RosProxy": Mistake(
        lambda site: site.create_app(labels={"rosproxy.io/injekt": "true"}), "UnknownName",
        (Cure(f"{ASTRAY}. Did you mean the label {INJECT}", "orrect the name in the template",
              _relabel("true", **{"rosproxy.io/injekt": None})),
         Cure("the namespace has no RosProxy, but 1 pod", "create a RosProxy in the namespace",
              _create_and_restart)),
    ),
    "annotation instead of the label": Mistake(
        _template(labels={}, annotations={INJECT: "true"}), "UnknownName",
        (Cure(f"annotation {INJECT} is ignored here. The operator reads only the label {INJECT}",
              "orrect the name in the template",
              edit_template({INJECT: "true"}, {INJECT: None})),),
    ),
    "True with a capital": Mistake(
        _template(labels={INJECT: "True"}), "NotWired",
        (Cure(f"label {INJECT}=True names no RosProxy of namespace {{ns}}",
              "Set the label to true in lower case in the template", _relabel("true")),),
    ),
    "label names no RosProxy": Mistake(
        _template(labels={INJECT: "robott"}), "NotWired",
        (Cure(f"label {INJECT}=robott names no RosProxy of namespace {{ns}}",
              "Set the label to robot in the template", _relabel("robot")),),
    ),
    "no RosProxy": Mistake(
        lambda site: site.create_app(), "NotWired",
        (Cure(f"the namespace has no RosProxy, but 1 pod with the label {INJECT}",
              "create a RosProxy in the namespace", _create_and_restart),),
    ),
    "RosProxy after the pod": Mistake(
        _late_rosproxy, "NotWired",
        (Cure("since the pod is older than RosProxy robot", "Run kubectl", restart),),
    ),
    "two RosProxies": Mistake(
        _two, "Ambiguous",
        (Cure("is selected by RosProxy robot and second, so the pod gets no proxy",
              f"Set the label to the name of one RosProxy, such as {INJECT}=robot in the template",
              _relabel("robot")),),
    ),
    "guide's example for ROS 2 beside that for ROS 1": Mistake(
        _both_examples, "Ambiguous",
        (Cure("is selected by RosProxy robot and robot2. This pod stays with robot",
              f"Set the label to the name of one RosProxy, such as {INJECT}=robot in the template",
              _relabel_registered),),
        is_silent=False,  # the running pod keeps its proxy
    ),
    "another master in the template": Mistake(
        _template(env={"ROS_MASTER_URI": "http://192.0.2.7:11311"}), "NotWired",
        (Cure("variable ROS_MASTER_URI=http://192.0.2.7:11311 of the template does not lead to the "
              "proxy", "Remove the variable from the template", _without_variables),),
    ),
    "hostNetwork": Mistake(
        _template(hostNetwork=True), "HostNetwork",
        (Cure("is on the node's own network (hostNetwork), where ROS nodes need no proxy",
              f"Remove hostNetwork or the label {INJECT} from the template",
              edit_template(hostNetwork=None)),),
    ),
    "labels of the selector": Mistake(
        _both({"podSelector": {"matchLabels": {"app": "other"}}}, {}), "NotWired",
        (Cure("do not match spec.podSelector of RosProxy robot (app=other)",
              "Or correct the selector", _right_selector),),
    ),
    "pods without the label": Mistake(
        _both({"podSelector": {"matchLabels": {"app": APP}}}, {"labels": {}}), "NotWired",
        (Cure(f"since the pod has no label {INJECT}",
              f"Add the label {INJECT}=robot to the template", _relabel("robot")),),
    ),
    "master refuses": Mistake(
        _spec(master={"uri": f"http://{ROBOT_ADDRESS}:1"}), "MasterUnreachable",
        (Cure("No roscore listens there. Check the port",
              f"allow connections from pods to http://{ROBOT_ADDRESS}:1, or correct spec.master",
              _set_master),),
    ),
    "firewall before the master": Mistake(
        _block_master, "MasterUnreachable",
        (Cure("no answer in", f"allow connections from pods to "
              f"http://{ROBOT_ADDRESS}:", by_hand(_open_master)),),
        _open_master,
    ),
    "name of the master": Mistake(
        _unknown_name, "MasterUnreachable",
        (Cure("host name robott can't be resolved",
              "set spec.master.address to the IP address of that host",
              edit_rosproxy(master={"address": ROBOT_ADDRESS})),),
    ),
    "Service of the master": Mistake(
        _spec(master={"service": {"name": "roscore"}}), "MasterUnknown",
        (Cure("Service {ns}/roscore does not exist",
              "Create the Service, or correct spec.master.service", _set_master),),
    ),
    "port of the master's Service": Mistake(
        _other_port, "MasterUnknown",
        (Cure("Service {ns}/master has no port 11311 (its ports: 11400)",
              "Set spec.master.service.port",
              edit_rosproxy(master={"service": {"name": "master", "port": 11400}})),),
    ),
    "headless Service of the master": Mistake(
        _headless, "MasterUnknown",
        (Cure("Service {ns}/master is headless",
              "Delete the Service, and create it without clusterIP: None",
              by_hand(_with_an_address)),),
    ),
    "fewer ports than ROS nodes": Mistake(
        _two_nodes_for_a_port, "ProxyWarns",
        (Cure("no port is free, 1 used", "set a larger spec.ports", _more_ports),),
        words=("one", "two"),
        is_silent=False,  # one of both nodes has the port
    ),
    "image": Mistake(
        _spec(**IMAGE), "ProxyStuck",
        (Cure("the node can't get the image rosproxy:typo (",
              "Load the image on the node, or correct spec.image or spec.imagePullPolicy",
              edit_rosproxy(image=None, imagePullPolicy=None)),),
    ),
    "image that is not allowed": Mistake(
        _spec(image="example.org/other:1"), "NotAllowed",
        (Cure("spec.image: the operator does not allow 'example.org/other:1'", "Remove the field",
              edit_rosproxy(image=None)), RESTART_THE_POD),
    ),
    "no node fits": Mistake(
        _spec(nodeSelector={"kubernetes.io/hostname": "nowhere"}), "NodeLeftOut",
        (Cure("does not match spec.nodeSelector, so selected pods there have no proxy",
              "Widen spec.nodeSelector", edit_rosproxy(nodeSelector=None)),),
    ),
    "taint of the node": Mistake(
        _taint, "ProxyStuck",
        (Cure("untolerated taint", "Set spec.tolerations as in your pods",
              edit_rosproxy(tolerations=[{"key": "robots", "operator": "Exists"}])),),
        _untaint,
    ),
    "more memory than a node has": Mistake(
        _spec(resources={"requests": {"memory": "4Ti"}, "limits": {"memory": "4Ti"}}), "ProxyStuck",
        (Cure("Insufficient memory", "lower spec.resources.requests",
              edit_rosproxy(resources=None)),),
    ),
    "no external address": Mistake(
        _spec(advertise="ExternalIP"), "NoAdvertiseHost",
        (Cure("has no address of type ExternalIP", "Set another spec.advertise",
              edit_rosproxy(advertise="InternalIP")),),
    ),
    "name that outside does not know": Mistake(
        _name_of_the_node, "ProxyWarns",
        (Cure("can't be resolved", "set spec.advertise", edit_rosproxy(advertise="InternalIP")),
         Cure("The ROS nodes of this pod may have been unregistered", "Run kubectl", restart)),
    ),
    "program at the ports of the proxy": Mistake(
        _program_at_the_ports, "PortsUnreachable",
        (Cure("outside does not reach ports 12600-12607 of 10.88.0.11 (another program answers",
              "set a spec.portWindow without these ports", by_hand(_other_window)),
         Cure("The ROS nodes of this pod may have been unregistered", "Run kubectl", restart)),
        _end_program,
    ),
    "ports of NodePorts": Mistake(
        _spec(portWindow={"first": 30000, "last": 30100}), "PortsExhausted",
        (Cure("no 8 free ports in a row between 30000 and 30100", "Widen spec.portWindow",
              edit_rosproxy(portWindow=None)),),
    ),
    "name is taken": Mistake(
        _namesake, "ProxyNotAdmitted",
        (Cure("a Service of this name exists already that the operator did not create",
              "Delete that object", by_hand(_no_namesake)), RESTART_THE_POD),
    ),
    "quota of pods": Mistake(
        _quota_of_pods, "ProxyNotAdmitted",
        (Cure("exceeded quota: small, requested: pods=1", "Raise this ResourceQuota",
              by_hand(_more_pods)),),
    ),
    "quota that wants limits": Mistake(
        _quota_of_cpu, "ProxyNotAdmitted",
        (Cure("must specify limits.cpu", "Set spec.resources.limits.cpu",
              edit_rosproxy(resources={"limits": {"cpu": "500m", "memory": "256Mi"}})),),
    ),
    "LimitRange": Mistake(
        _limit_range, "ProxyNotAdmitted",
        (Cure("maximum memory usage per Container is 256Mi",
              "Lower spec.resources, or raise the maximum in the LimitRange",
              edit_rosproxy(resources={"limits": {"memory": "256Mi"},
                                       "requests": {"memory": "64Mi"}})),),
    ),
    "Pod Security": Mistake(
        _pod_security, "ProxyNotAdmitted",
        (Cure('violates PodSecurity "baseline', "This requires Pod Security privileged",
              _privileged),),
    ),
}  # fmt: skip
ROS2_MISTAKES: dict[str, Mistake] = {
    "domain in the template": Mistake(
        _both({**OF_ROS2, "domain": 3}, {"env": {"ROS_DOMAIN_ID": "7"}}), "OtherDomain",
        (Cure("variable ROS_DOMAIN_ID=7 is not domain 3 of RosProxy robot",
              "Remove the variable from the template", _without_variables),),
        domain=3,
    ),
    **{
        f"domain {former.get('domain')} of a RosProxy changes": Mistake(
            _other_domain(former), "OtherDomain",
            (Cure("but RosProxy robot has domain 4 now", "Run kubectl", restart),),
            domain=4,
        )
        for former in ({"domain": 3}, {})
    },
    "no discovery": Mistake(
        _both(OF_ROS2, {"env": {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}}), "NotDiscovered",
        (Cure("variable ROS_AUTOMATIC_DISCOVERY_RANGE=OFF. The nodes discover only nodes on their",
              "Unset the variable, or set SUBNET. Edit the template", _without_variables),),
    ),
    "discovery server": Mistake(
        _both(OF_ROS2, {"env": {"ROS_DISCOVERY_SERVER": "192.0.2.7:11811"}}), "NotDiscovered",
        (Cure("variable ROS_DISCOVERY_SERVER=192.0.2.7:11811. The nodes announce themselves only",
              "Unset the variable. Edit the template", _without_variables),),
    ),
}  # fmt: skip


@pytest.fixture
def robot(_cluster: None) -> Iterator[Robot]:
    """A robot with a new master: the doctor names what former tests have left at a master."""
    with robot_with_master() as started_robot:
        yield started_robot


@pytest.fixture(scope="module")
def robot2(_release: None) -> Iterator[Robot2]:
    with robot_with_ros2() as started_robot:
        yield started_robot


@pytest.mark.parametrize("name", MISTAKES)
def test_the_doctor_names_a_mistake_and_the_fix_works(
    name: str, net: Namespace, robot: Robot
) -> None:
    walk_through(MISTAKES[name], Site(net, robot))


@pytest.mark.parametrize("name", ROS2_MISTAKES)
def test_the_doctor_names_a_mistake_with_ros2_and_the_fix_works(
    name: str, net: Namespace, robot: Robot, robot2: Robot2
) -> None:
    walk_through(ROS2_MISTAKES[name], Site(net, robot, robot2))


def test_a_new_proxy_beside_a_running_robot_is_well(
    net: Namespace, robot: Robot, robot2: Robot2
) -> None:
    """The robot discovers the proxy while the proxy starts. This is no mistake."""
    site = Site(net, robot, robot2)
    with site.listener() as heard:
        site.create_rosproxy(**OF_ROS2)
        site.create_app()
        heard.wait_for("inside", seconds=START)
        # A problem of the start would be reported for `RECENT_S`, 300 s.
        wait_until(site.is_well, 60, site.rosproxy.tell)
        assert not errors(net.name)
