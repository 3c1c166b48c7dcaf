"""The status of a RosProxy, for kubectl."""

import json

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from rosproxy.shared.documents.status_document import RangeProbeStatus
from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.resources.cluster import (
    HelperPod,
    Obstacle,
    PodFailure,
    ProxyReport,
    RosProxyOnNode,
)
from rosproxy_operator.kubernetes.resources.model import InvalidRosProxy, Selector
from rosproxy_operator.kubernetes.resources.names import IMAGE_CHECK, LAN_RELAY
from rosproxy_operator.kubernetes.status.findings import pod_finding
from rosproxy_operator.kubernetes.status.rosproxy_status import (
    MOST_MESSAGE_CHARACTERS,
    MOST_NAMES,
    MOST_NODES,
    status_of_invalid,
)
from tests.unit.operator.kubernetes.builders_api import (
    LATER,
    ROBOT,
    STAMP,
    URI,
    answer,
    condition,
    judged,
    message,
    pod,
    proxy,
    rosproxy,
    state,
    status,
    stuck_proxy,
)

POD = proxy("node1").pod.id


def test_all_is_well():
    rosproxy_status = status(state("node2", answer=answer("/a", "/b")), state("node1"))

    assert {
        key: value for key, value in rosproxy_status.items() if key not in ("perNode", "conditions")
    } == {
        "observedGeneration": 3,
        "message": "2 of 2 proxies serve 3 ROS nodes",
        "master": ROBOT,
        "masterURI": URI,
        "nodes": 2,
        "proxies": "2/2",
        "rosNodes": 3,
        "topics": 1,
        "addresses": "node1: 192.0.2.11, node2: 192.0.2.11",
        "ports": "11400-11431",
        "livePage": f"kubectl -n {POD.namespace} port-forward {POD.name} 11312"
        " # then http://localhost:11312/",
    }
    assert [(c["type"], c["status"], c["reason"]) for c in rosproxy_status["conditions"]] == [
        ("Ready", "True", "Serving"),
        ("PortsAllocated", "True", "Allocated"),
        ("MasterReachable", "True", "Reached"),
        ("PortsReachable", "True", "Reached"),
        ("Degraded", "False", "AsExpected"),
    ]
    assert message(rosproxy_status) == "2 of 2 proxies serve 3 ROS nodes"
    assert {c["lastTransitionTime"] for c in rosproxy_status["conditions"]} == {STAMP}
    assert {c["observedGeneration"] for c in rosproxy_status["conditions"]} == {3}


def test_the_live_page_is_that_of_a_proxy_that_works():
    silent = answer(answered=False)
    first = state("node1", answer=silent)
    assert proxy("node2").pod.id.name in status(first, state("node2"))["livePage"]
    assert status(first, state("node2", proxy=None))["livePage"] == ""


def test_a_node_in_the_status():
    rosproxy_status = status(state())

    assert rosproxy_status["perNode"] == [
        {
            "name": "node1",
            "advertiseHost": "192.0.2.11",
            "ports": "11400-11431",
            "proxy": proxy().pod.id.name,
            "ready": True,
            "pods": 1,
            "rosNodes": 1,
            "names": ["/talker"],
            "topics": 1,
        }
    ]


def test_a_node_that_only_keeps_its_range():
    former_node = RosProxyOnNode("node9", "", PortRange(12000, 12031))

    rosproxy_status = status(state(), former_node)

    assert rosproxy_status["perNode"][1] == {
        "name": "node9",
        "ports": "12000-12031",
        "ready": False,
        "pods": 0,
        "rosNodes": 0,
        "names": [],
        "topics": 0,
    }
    assert (rosproxy_status["nodes"], rosproxy_status["proxies"], rosproxy_status["ports"]) == (
        1,
        "1/1",
        "11400-11431",
    )
    assert judged(rosproxy_status, "Ready") == ("True", "Serving")


def test_ports_that_differ_are_told_by_node():
    node2 = state("node2", range=PortRange(12000, 12031))

    assert status(node2, state())["ports"] == "node1: 11400-11431, node2: 12000-12031"


def test_the_wide_output_tells_which_node_is_not_ready_and_why():
    node2 = state("node2", proxy=stuck_proxy(PodFailure.IMAGE), answer=None)

    rosproxy_status = status(node2, state())

    assert rosproxy_status["addresses"] == "node1: 192.0.2.11, node2: 192.0.2.11 (not ready)"
    assert rosproxy_status["message"] == message(rosproxy_status)
    assert "the node can't get the image" in rosproxy_status["message"]


def test_a_node_tells_first_why_its_proxy_is_stuck():
    stuck = stuck_proxy(PodFailure.CRASHING)
    made = (stuck.pod, stuck.of, stuck.owner, "node1", "f", "rosproxy:2")
    relay, check = (
        HelperPod(*made, stuck=PodFailure.IMAGE, component=component)
        for component in (LAN_RELAY, IMAGE_CHECK)
    )
    node = state(proxy=stuck, answer=None, lan_relay=relay, image_check=check)
    (line,) = status(node)["perNode"]
    assert "the container ends again and again" in line["message"]


def test_the_wide_output_tells_the_first_problem_of_a_rosproxy_that_is_ready():
    astray = pod_finding(
        pod("astray"), rosproxy(), "NotWired", Fault("has no variable"), fatal=False
    )
    rosproxy_status = status(state(), more=(astray,))

    assert judged(rosproxy_status, "Ready") == ("True", "Serving")
    assert rosproxy_status["message"] == "pod robots/astray: has no variable"


def test_selected_pods_without_a_node_are_no_reason_for_a_label():
    """The status and the doctor advised to add the label, which the pods had."""
    waiting = [pod(f"talker-{number}", node="") for number in range(5)]
    rosproxy_status = status(unscheduled=waiting)

    assert judged(rosproxy_status, "Ready") == ("True", "NoPods")
    assert message(rosproxy_status) == (
        "no selected pod runs on a node yet (5 pods). Read the Events: kubectl -n robots describe "
        "pod talker-0 talker-1 talker-2"
    )


def test_no_pod_is_selected():
    rosproxy_status = status()

    assert judged(rosproxy_status, "Ready") == ("True", "NoPods")
    assert (
        message(rosproxy_status)
        == "no pod is selected. Add the label rosproxy.io/inject=arm to the template of your pods"
    )
    assert judged(rosproxy_status, "PortsAllocated") == ("True", "NoPods")
    assert judged(rosproxy_status, "MasterReachable") == ("Unknown", "NoProxies")
    assert judged(rosproxy_status, "PortsReachable") == ("Unknown", "NoProxies")
    assert (rosproxy_status["nodes"], rosproxy_status["proxies"], rosproxy_status["ports"]) == (
        0,
        "0/0",
        "",
    )


def test_no_pod_is_selected_by_labels_of_its_own():
    assert "spec.podSelector" in message(status(of=rosproxy(selector=Selector({"a": "b"}))))


def test_times_change_with_the_status_only():
    first = status(state())
    second = status(
        state(answer=answer("/a", problems=("x: y",))), of=rosproxy(status=first), stamp=LATER
    )

    assert condition(second, "Ready")["lastTransitionTime"] == STAMP
    assert message(second) == "1 of 1 proxies serve 1 ROS node"
    assert condition(second, "Degraded")["lastTransitionTime"] == LATER


def test_nothing_new_is_the_same_status():
    first = status(state())

    assert status(state(), of=rosproxy(status=first), stamp=LATER) == first
    assert json.loads(json.dumps(first)) == first


def test_a_controller_that_has_just_started_changes_nothing():
    asked = [state(), state("node2", answer=answer("/b", topics=frozenset({"/other"})))]
    first = status(*asked)

    silent = [replace(node_state, answer=None) for node_state in asked]

    assert status(*silent, of=rosproxy(status=first), stamp=LATER) == first


def test_what_was_known_of_the_master_holds_on_until_a_proxy_has_told():
    down = state(proxy=proxy(ready=False), answer=ProxyReport(True, False, "refused"))
    first = status(down)

    rosproxy_status = status(replace(down, answer=None), of=rosproxy(status=first), stamp=LATER)

    assert condition(rosproxy_status, "MasterReachable") == condition(first, "MasterReachable")


def test_the_address_of_a_service_that_is_gone_is_kept():
    first = status(state())

    rosproxy_status = status(state(), of=rosproxy(status=first), cluster_ip="")

    assert rosproxy_status["masterURI"] == URI
    assert status(cluster_ip="")["masterURI"] == ""


def test_one_that_can_not_be_read_keeps_what_it_has():
    first = status(state())
    text = "spec.ports: 0 is not valid"
    fix = "Write an integer from 1 to 500"
    bad = InvalidRosProxy(rosproxy().id, "uid-arm", 4, text, fix, first)

    rosproxy_status = status_of_invalid(bad, LATER)

    changed = ("conditions", "observedGeneration", "message")
    assert {key: rosproxy_status[key] for key in first if key not in changed} == {
        key: first[key] for key in first if key not in changed
    }
    assert rosproxy_status["observedGeneration"] == 4
    assert rosproxy_status["message"] == message(rosproxy_status) == f"{text}. {fix}"
    assert judged(rosproxy_status, "Ready") == ("False", "Invalid")
    assert judged(rosproxy_status, "Degraded") == ("True", "Invalid")
    assert condition(rosproxy_status, "MasterReachable")["lastTransitionTime"] == STAMP
    again = status_of_invalid(replace(bad, status=rosproxy_status), "2026-11-21T16:00:00Z")
    assert again == rosproxy_status


def test_one_that_could_never_be_read():
    bad = InvalidRosProxy(rosproxy().id, "uid-arm", 1, "spec.ports: 0")

    assert len(status_of_invalid(bad, STAMP)["conditions"]) == 2


def test_a_large_cluster_is_told_in_bounds():
    names = [f"/{'n' * 300}{i}" for i in range(80)]
    problems = tuple(f"{i}: {'x' * 200}" for i in range(20))
    states = [
        state(
            f"node{i:03}",
            range=PortRange(11400 + i, 11431 + i),
            answer=answer(*names, problems=problems),
        )
        for i in range(MOST_NODES + 50)
    ]
    former_nodes = [RosProxyOnNode(f"a{i}", "", PortRange(12000, 12031)) for i in range(10)]

    rosproxy_status = status(*states, *former_nodes)

    assert len(rosproxy_status["perNode"]) == MOST_NODES
    assert all(line["pods"] for line in rosproxy_status["perNode"])
    assert all(line["rosNodes"] == 80 for line in rosproxy_status["perNode"])
    assert rosproxy_status["rosNodes"] == 80 * (MOST_NODES + 50)
    assert rosproxy_status["nodes"] == MOST_NODES + 50
    assert all(len(c["message"]) <= MOST_MESSAGE_CHARACTERS for c in rosproxy_status["conditions"])
    assert len(json.dumps(rosproxy_status)) < 700_000


def test_the_sum_stays_while_the_proxy_of_a_node_without_a_line_has_not_answered():
    def states(last: ProxyReport | None):
        every = [state(f"node{i:03}", answer=answer("/a")) for i in range(MOST_NODES)]
        return [*every, state("other", answer=last)]

    first = status(*states(answer("/a", "/b")))
    assert first["rosNodes"] == MOST_NODES + 2
    restarted = status(*states(None), of=rosproxy(status=first))
    assert restarted["rosNodes"] == MOST_NODES + 2
    now = status(*states(answer("/a")), of=rosproxy(status=restarted))
    assert now["rosNodes"] == MOST_NODES + 1


def test_so_many_names_of_a_node_are_told():
    rosproxy_status = status(state(answer=answer(*(f"/n{i:03}" for i in range(80)))))

    assert len(rosproxy_status["perNode"][0]["names"]) == MOST_NAMES
    assert rosproxy_status["perNode"][0]["rosNodes"] == 80


def test_names_are_harmless():
    rosproxy_status = status(state(answer=answer("/a\x1b[2J")))

    assert rosproxy_status["perNode"][0]["names"] == ["/a\\x1b[2J"]


_answers = st.none() | st.builds(
    ProxyReport,
    st.booleans(),
    st.booleans(),
    st.just("refused"),
    st.dictionaries(st.just("10.0.0.1"), st.lists(st.text(), max_size=3).map(tuple)),
    problems=st.lists(st.text(max_size=9), max_size=2).map(tuple),
    range_probe=st.none()
    | st.builds(
        RangeProbeStatus,
        st.none() | st.booleans(),
        st.sampled_from(["ok", "refused", "never heard of"]),
    ),
)
_proxies = st.none() | st.builds(
    lambda ready, why, gone: proxy(ready=ready, stuck=why, pod={"deleting": gone}),
    st.booleans(),
    st.none() | st.sampled_from(PodFailure),
    st.booleans(),
)
_states = st.lists(
    st.builds(
        RosProxyOnNode,
        st.sampled_from(["node1", "node2", "node3"]),
        st.just("192.0.2.1"),
        st.none() | st.just(PortRange(11400, 11431)),
        _proxies,
        st.sampled_from([(), (pod(),)]),
        _answers,
        st.none() | st.builds(Obstacle, st.sampled_from(["Reason", "no reason"]), st.just("wrong")),
    ),
    max_size=3,
    unique_by=lambda node_state: node_state.name,
).map(tuple)


@given(_states)
def test_every_status_is_one_that_the_api_server_takes(states):
    rosproxy_status = status(*states)

    assert json.loads(json.dumps(rosproxy_status)) == rosproxy_status
    assert [c["type"] for c in rosproxy_status["conditions"]] == [
        "Ready",
        "PortsAllocated",
        "MasterReachable",
        "PortsReachable",
        "Degraded",
    ]
    for status_condition in rosproxy_status["conditions"]:
        assert status_condition["status"] in ("True", "False", "Unknown")
        assert status_condition["reason"].isidentifier()
        assert status_condition["message"]


@given(_states, _states)
def test_a_status_settles_at_once(before, states):
    first = status(*states, of=rosproxy(status=status(*before)), stamp=STAMP)

    assert status(*states, of=rosproxy(status=first), stamp=LATER) == first


@given(_states)
def test_ready_means_that_every_node_with_pods_is_served(states):
    rosproxy_status = status(*states)

    served = [
        node_state.proxy is not None
        and not node_state.proxy.pod.deleting
        and node_state.proxy.ready
        and node_state.proxy.stuck is None
        and (node_state.answer is None or node_state.answer.answered)
        for node_state in states
        if node_state.pods
    ]
    assert condition(rosproxy_status, "Ready")["status"] == str(all(served))
    assert rosproxy_status["proxies"] == f"{sum(served)}/{len(served)}"


def test_where_no_proxy_runs_nothing_is_said_of_the_master():
    """With 0 of 2 proxies, the status must not keep MasterReachable for minutes."""
    first = status(state())
    assert judged(first, "MasterReachable") == ("True", "Reached")
    stuck = state(proxy=stuck_proxy(PodFailure.IMAGE), answer=None)
    later = status(stuck, of=rosproxy(status=first))
    assert judged(later, "MasterReachable") == ("Unknown", "NoProxies")
    assert judged(later, "PortsReachable") == ("Unknown", "NoProxies")
