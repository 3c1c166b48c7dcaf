"""The status of a RosProxy."""

from tests.docker.engine import wait_until
from tests.kubernetes import api
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.pods import Namespace, unique
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import NOWHERE, rosproxy
from tests.kubernetes.traffic import START, wait_for_service


def test_status_and_columns(net: Namespace, robot: Robot) -> None:
    topic = f"/{unique('told').replace('-', '_')}"
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    wait_for_service(net)
    pod = net.node("roscpp", "pub", "--topic", topic, "--word", "inside", on="node1")
    net.idle(on="node2")

    made.wait_status(lambda s: s.get("proxies") == "2/2", "both proxies are ready")
    made.wait_for("Ready")
    made.wait_for("PortsReachable")
    made.wait_status(lambda s: s.get("topics", 0) >= 1, "the topic is counted", START)
    status = made.wait_status(lambda s: s.get("rosNodes") == 1, "the ROS node is counted")

    assert status["observedGeneration"] == made.body["metadata"]["generation"]
    assert status["master"] == robot.master_uri
    assert status["masterURI"] == f"http://{made.service['spec']['clusterIP']}:11311"
    assert status["nodes"] == 2
    here = made.on("node1")
    assert here["advertiseHost"] == "10.88.0.11"
    assert here["names"] == [f"/{pod.node}"]
    assert (here["pods"], here["rosNodes"], here["ready"]) == (1, 1, True)
    assert here["proxy"] == made.the_proxy("node1").name
    conditions = {c["type"]: c["status"] for c in status["conditions"]}
    assert conditions == {
        "Ready": "True",
        "PortsAllocated": "True",
        "MasterReachable": "True",
        "PortsReachable": "True",
        "Degraded": "False",
    }
    narrow = kubectl("get", "rosproxy", "-n", net.name).splitlines()
    assert narrow[0].split() == ["NAME", "MASTER", "DOMAIN", "NODES", "PROXIES", "READY", "AGE"]
    assert narrow[1].split()[:5] == ["robot", robot.master_uri, "2", "2/2", "True"]
    wide = kubectl("get", "rp", "-n", net.name, "-o", "wide").splitlines()
    more = ["ADDRESSES", "PORTS", "ROS-NODES", "PARTICIPANTS", "TOPICS", "MASTER-URI", "MESSAGE"]
    assert wide[0].split()[7:] == more
    assert "node1: 10.88.0.11, node2: 10.88.0.12" in wide[1]
    assert wide[1].endswith("2 of 2 proxies serve 1 ROS node")
    assert here["ports"] in wide[1]
    assert status["masterURI"] in wide[1]
    created = made.wait_event("ProxyCreated")
    assert created.type == "Normal"


def test_master_that_is_not_there(net: Namespace) -> None:
    made = rosproxy(net.name, master={"uri": "http://10.88.0.50:1"}, ports=4)
    net.idle(on="node1")
    condition = made.wait_for("MasterReachable", "False")
    assert "10.88.0.50" in condition["message"]
    assert made.wait_for("Ready", "False")["message"]
    made.wait_event("MasterUnreachable")


def test_no_pods_yet(net: Namespace) -> None:
    made = rosproxy(net.name, master=NOWHERE)
    made.wait_status(lambda s: s.get("nodes") == 0, "no nodes")
    assert made.proxies == []
    ready = made.condition("Ready")
    assert (ready["status"], ready["reason"]) == ("True", "NoPods")


def test_host_network_is_told_on_the_pod(net: Namespace) -> None:
    made = rosproxy(net.name, master=NOWHERE)
    made.wait_status(lambda s: s.get("nodes") == 0, "no nodes")
    pod = net.idle(on="node1", hostNetwork=True)

    def told() -> bool:
        every = api.objects("events", net.name)
        return any(
            e["reason"] == "HostNetwork" and e["involvedObject"]["name"] == pod.name for e in every
        )

    wait_until(told, 60, lambda: str(api.objects("events", net.name)))
    assert made.proxies == []


def test_image_that_is_not_there(net: Namespace) -> None:
    made = rosproxy(
        net.name, master=NOWHERE, ports=4, image="rosproxy:missing", imagePullPolicy="Never"
    )
    net.idle(on="node1")
    made.wait_event("ProxyStuck", "rosproxy:missing")
    assert "rosproxy:missing" in made.wait_for("Ready", "False")["message"]
    wide = kubectl("get", "rp", "-n", net.name, "-o", "wide")
    assert "node1: 10.88.0.11 (not ready)" in wide
    assert "the node can't get the image rosproxy:missing" in wide
    made.change(image=None)
    wait_until(lambda: any(p.body["status"].get("phase") == "Running" for p in made.proxies),
               40, made.tell)  # fmt: skip
