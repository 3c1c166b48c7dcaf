"""The Kubernetes Events of the operator."""

from dataclasses import replace

from rosproxy_operator.kubernetes.planner.actions import (
    Action,
    CreateProxy,
    DeleteProxy,
    Emit,
    PatchStatus,
    SetImage,
)
from rosproxy_operator.kubernetes.resources.model import ClusterFinding, Name, Reference
from rosproxy_operator.kubernetes.status.events import (
    EVENT_REPEAT_QUIET_S,
    MOST_MESSAGE_BYTES,
    MOST_RESULTS,
    MOST_TEXTS,
    MOST_WARNINGS,
    NewEvents,
    event_body,
    results,
    warnings,
)
from tests.unit.operator.kubernetes.builders_api import proxy_obj, rosproxy

ARM = Name("robots", "arm")
OF_ARM = Reference("RosProxy", ARM, "uid-arm")


def finding(text: str = "no ports", about: Reference | None = OF_ARM) -> ClusterFinding:
    return ClusterFinding("node node1", text, reason="PortsExhausted", of=ARM, about=about)


def test_a_problem_that_is_new_is_told():
    new_events = warnings([finding()], {}, 10.0)

    (emit,) = new_events.emits
    assert (emit.of, emit.type, emit.reason) == (ARM, "Warning", "PortsExhausted")
    assert emit.message == "node node1: no ports"
    assert event_body(emit, 0.0)["involvedObject"] == {
        "apiVersion": "rosproxy.io/v1alpha1",
        "kind": "RosProxy",
        "namespace": "robots",
        "name": "arm",
        "uid": "uid-arm",
    }
    assert new_events.reported == {finding(): 10.0}


def test_a_pods_problem_is_told_at_the_pod():
    pod = Reference("Pod", Name("robots", "talker"), "uid-talker")
    problem = ClusterFinding(
        "pod robots/talker", "is not wired", reason="NotWired", of=ARM, about=pod
    )

    (emit,) = warnings([problem], {}, 0.0).emits

    about = event_body(emit, 0.0)["involvedObject"]
    assert (about["apiVersion"], about["kind"]) == ("v1", "Pod")
    assert emit.message == "is not wired"


def test_a_problem_that_stays_is_not_told_again():
    told = warnings([finding()], {}, 0.0)
    for now in (3.0, 1000.0, 2000.0):
        told = warnings([finding()], told.reported, now)
        assert told.emits == ()


def test_a_problem_that_comes_and_goes_is_told_once():
    told = warnings([finding()], {}, 0.0)
    for now in range(3, 600, 3):
        told = warnings([finding()] if now % 2 else [], told.reported, float(now))
        assert told.emits == ()


def test_a_problem_that_comes_back_after_a_while_is_told_again():
    told = warnings([], warnings([finding()], {}, 0.0).reported, EVENT_REPEAT_QUIET_S)

    assert told.reported == {}
    assert len(warnings([finding()], told.reported, EVENT_REPEAT_QUIET_S + 1).emits) == 1


def test_another_text_is_another_problem():
    told = warnings([finding()], {}, 0.0)

    assert len(warnings([finding("other ports")], told.reported, 1.0).emits) == 1


def test_problems_without_an_object_make_no_event():
    assert warnings([finding(about=None)], {}, 0.0).emits == ()


def test_the_same_problem_twice_makes_one_event():
    assert len(warnings([finding(), finding()], {}, 0.0).emits) == 1


def test_many_problems_have_their_turn():
    many = [finding(str(i)) for i in range(MOST_WARNINGS + 5)]

    first = warnings(many, {}, 0.0)
    second = warnings(many, first.reported, 1.0)

    assert (len(first.emits), len(second.emits)) == (MOST_WARNINGS, 5)
    assert warnings(many, second.reported, 2.0).emits == ()


def test_a_problem_whose_text_changes_all_the_time_makes_few_events():
    """Otherwise a hostile proxy could cause an Event each half second."""
    told = NewEvents()
    emits = list[Emit]()
    for second in range(10 * int(EVENT_REPEAT_QUIET_S)):
        told = warnings([finding(str(second))], told.reported, float(second))
        emits += told.emits
    assert len(emits) <= 10 * (MOST_TEXTS + 1)
    assert len(told.reported) <= MOST_TEXTS + 1

    other = ClusterFinding("node node2", "no ports", reason="PortsExhausted", of=ARM, about=OF_ARM)
    told = warnings([other], told.reported, 10 * EVENT_REPEAT_QUIET_S)
    assert [emit.message for emit in told.emits] == ["node node2: no ports"]


def test_a_message_is_not_longer_than_the_api_server_takes():
    (emit,) = warnings([finding("ü" * MOST_MESSAGE_BYTES)], {}, 0.0).emits

    assert MOST_MESSAGE_BYTES - 3 <= len(emit.message.encode()) <= MOST_MESSAGE_BYTES
    assert emit.message.endswith("ü…")
    fixed = replace(finding("ü" * MOST_MESSAGE_BYTES), fix="Start the node")
    (emit,) = warnings([fixed], {}, 0.0).emits
    assert MOST_MESSAGE_BYTES - 4 <= len(emit.message.encode()) <= MOST_MESSAGE_BYTES
    assert emit.message.endswith("ü… Start the node")


def test_what_is_done_is_told():
    body = proxy_obj()
    pod = Name("robots", "rosproxy-arm-node1-1")
    actions: list[Action] = [
        CreateProxy(ARM, body),
        SetImage(ARM, pod, "u", "rosproxy:2"),
        DeleteProxy(ARM, pod, "u", "no selected pod is left on node1"),
        PatchStatus(ARM, "uid-arm", {}),
    ]

    emits = [*results(rosproxy(), actions)]

    name = body["metadata"]["name"]
    assert [(emit.type, emit.reason, emit.message) for emit in emits] == [
        ("Normal", "ProxyCreated", f"created pod {name} on node node1 with ports 11400-11431"),
        ("Normal", "ImageSet", f"set the image of pod {pod.name} to rosproxy:2"),
        ("Normal", "ProxyDeleted", f"deleted pod {pod.name}: no selected pod is left on node1"),
    ]
    assert {emit.about for emit in emits} == {OF_ARM}


def test_what_is_done_to_many_is_summed_up():
    of_all = 3 * MOST_RESULTS
    actions: list[Action] = [
        DeleteProxy(ARM, Name("robots", f"pod-{number}"), "u", "gone") for number in range(of_all)
    ]

    *single_results, last = results(rosproxy(), actions)

    assert len(single_results) == MOST_RESULTS
    more = of_all - MOST_RESULTS
    assert last.message == f"and {more} more at the same time. Read the operator's log"
