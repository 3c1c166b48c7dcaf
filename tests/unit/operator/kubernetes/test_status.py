"""The status of a RosProxy: what kubectl shows of it."""

import json

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from rosproxy.leases.ports import PortRange
from rosproxy_operator.kubernetes.resources.cluster import (
    Obstacle,
    PodFailure,
    ProxyReport,
    RosProxyOnNode,
)
from rosproxy_operator.kubernetes.resources.model import InvalidRosProxy, Selector
from rosproxy_operator.kubernetes.status.rosproxy_status import (
    LONGEST,
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
)


def test_all_is_well():
    found = status(state("node2", answer=answer("/a", "/b")), state("node1"))

    assert {key: value for key, value in found.items() if key not in ("perNode", "conditions")} == {
        "observedGeneration": 3,
        "master": ROBOT,
        "masterURI": URI,
        "nodes": 2,
        "proxies": "2/2",
        "rosNodes": 3,
        "topics": 1,
        "ports": "11400-11431",
    }
    assert [(one["type"], one["status"], one["reason"]) for one in found["conditions"]] == [
        ("Ready", "True", "Serving"),
        ("PortsAllocated", "True", "Allocated"),
        ("MasterReachable", "True", "Reached"),
        ("Degraded", "False", "AsExpected"),
    ]
    assert message(found) == "2 of 2 proxies serve 3 ROS nodes"
    assert {one["lastTransitionTime"] for one in found["conditions"]} == {STAMP}
    assert {one["observedGeneration"] for one in found["conditions"]} == {3}


def test_a_node_in_the_status():
    found = status(state())

    assert found["perNode"] == [
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
    kept = RosProxyOnNode("node9", "", PortRange(12000, 12031))

    found = status(state(), kept)

    assert found["perNode"][1] == {
        "name": "node9",
        "ports": "12000-12031",
        "ready": False,
        "pods": 0,
        "rosNodes": 0,
        "names": [],
        "topics": 0,
    }
    assert (found["nodes"], found["proxies"], found["ports"]) == (1, "1/1", "11400-11431")
    assert judged(found, "Ready") == ("True", "Serving")


def test_ports_that_differ_are_told_by_node():
    other = state("node2", range=PortRange(12000, 12031))

    assert status(other, state())["ports"] == "node1: 11400-11431, node2: 12000-12031"


def test_no_pod_is_selected():
    found = status()

    assert judged(found, "Ready") == ("True", "NoPods")
    assert message(found) == "no pod is selected: label pods with rosproxy.io/inject=true"
    assert judged(found, "PortsAllocated") == ("True", "NoPods")
    assert judged(found, "MasterReachable") == ("Unknown", "NoProxies")
    assert (found["nodes"], found["proxies"], found["ports"]) == (0, "0/0", "")


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

    silent = [replace(one, answer=None) for one in asked]

    assert status(*silent, of=rosproxy(status=first), stamp=LATER) == first


def test_what_was_known_of_the_master_holds_on_until_a_proxy_has_told():
    down = state(proxy=proxy(ready=False), answer=ProxyReport(True, False, "refused"))
    first = status(down)

    found = status(replace(down, answer=None), of=rosproxy(status=first), stamp=LATER)

    assert condition(found, "MasterReachable") == condition(first, "MasterReachable")


def test_the_address_of_a_service_that_is_gone_is_kept():
    first = status(state())

    found = status(state(), of=rosproxy(status=first), cluster_ip="")

    assert found["masterURI"] == URI
    assert status(cluster_ip="")["masterURI"] == ""


def test_one_that_can_not_be_read_keeps_what_it_has():
    first = status(state())
    text = "spec.ports: 0 is not valid: write an integer from 1 to 500"
    bad = InvalidRosProxy(rosproxy().id, "uid-arm", 4, text, first)

    found = status_of_invalid(bad, LATER)

    assert {
        key: found[key] for key in first if key not in ("conditions", "observedGeneration")
    } == {key: first[key] for key in first if key not in ("conditions", "observedGeneration")}
    assert found["observedGeneration"] == 4
    assert judged(found, "Ready") == ("False", "Invalid")
    assert message(found) == text
    assert judged(found, "Degraded") == ("True", "Invalid")
    assert condition(found, "MasterReachable")["lastTransitionTime"] == STAMP
    again = status_of_invalid(replace(bad, status=found), "2026-11-21T16:00:00Z")
    assert again == found


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
    kept = [RosProxyOnNode(f"a{i}", "", PortRange(12000, 12031)) for i in range(10)]

    found = status(*states, *kept)

    assert len(found["perNode"]) == MOST_NODES
    assert all(line["pods"] for line in found["perNode"])
    assert all(line["rosNodes"] == 80 for line in found["perNode"])
    assert found["nodes"] == MOST_NODES + 50
    assert all(len(one["message"]) <= LONGEST for one in found["conditions"])
    assert len(json.dumps(found)) < 700_000


def test_so_many_names_of_a_node_are_told():
    found = status(state(answer=answer(*(f"/n{i:03}" for i in range(80)))))

    assert len(found["perNode"][0]["names"]) == MOST_NAMES
    assert found["perNode"][0]["rosNodes"] == 80


def test_names_are_harmless():
    found = status(state(answer=answer("/a\x1b[2J")))

    assert found["perNode"][0]["names"] == ["/a\\x1b[2J"]


_answers = st.none() | st.builds(
    ProxyReport,
    st.booleans(),
    st.booleans(),
    st.just("refused"),
    st.dictionaries(st.just("10.0.0.1"), st.lists(st.text(), max_size=3).map(tuple)),
    problems=st.lists(st.text(max_size=9), max_size=2).map(tuple),
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
    unique_by=lambda one: one.name,
).map(tuple)


@given(_states)
def test_every_status_is_one_that_the_api_server_takes(states):
    found = status(*states)

    assert json.loads(json.dumps(found)) == found
    assert [one["type"] for one in found["conditions"]] == [
        "Ready",
        "PortsAllocated",
        "MasterReachable",
        "Degraded",
    ]
    for one in found["conditions"]:
        assert one["status"] in ("True", "False", "Unknown")
        assert one["reason"].isidentifier()
        assert one["message"]


@given(_states, _states)
def test_a_status_settles_at_once(before, states):
    first = status(*states, of=rosproxy(status=status(*before)), stamp=STAMP)

    assert status(*states, of=rosproxy(status=first), stamp=LATER) == first


@given(_states)
def test_ready_means_that_every_node_with_pods_is_served(states):
    found = status(*states)

    served = [
        one.proxy is not None
        and not one.proxy.pod.deleting
        and one.proxy.ready
        and one.proxy.stuck is None
        and (one.answer is None or one.answer.answered)
        for one in states
        if one.pods
    ]
    assert condition(found, "Ready")["status"] == str(all(served))
    assert found["proxies"] == f"{sum(served)}/{len(served)}"
