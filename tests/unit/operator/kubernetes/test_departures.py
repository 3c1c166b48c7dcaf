"""Departed addresses for a proxy: never the address of a running pod."""

from typing import Any

from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.departures import (
    DEPARTURE_RECHECK_S,
    GONE_ADDRESS_KEPT_S,
    UNKNOWN_ADDRESS_GRACE_S,
    find_departures,
    next_checks,
)
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, ProxyReport
from tests.unit.operator.kubernetes.objects import look, node, observed, pod, proxy, rosproxy

PROXY = "uid-proxy-robot-one"
TALKER = "10.244.1.7"
LISTENER = "10.244.1.8"


def seen(*things: Any, names: tuple[str, ...] = (TALKER,), **more: Any) -> ClusterSnapshot:
    answer = ProxyReport(True, True, nodes=dict.fromkeys(names, ("/a",)))
    return observed(rosproxy(), proxy(), *things, **{"reports": {PROXY: answer}} | more)


def remembering(*things: Any) -> ClusterState:
    return find_departures(seen(*things), ClusterState(), 0.0).state


KNOWN = remembering(pod(ip=TALKER))


def told(
    observed_: ClusterSnapshot, memory: ClusterState = KNOWN, now: float = 1.0
) -> tuple[str, ...]:
    return find_departures(observed_, memory, now).addresses.get(PROXY, ())


def test_nodes_of_a_pod_that_runs_are_not_gone() -> None:
    assert told(seen(pod(ip=TALKER))) == ()


def test_nodes_of_a_pod_that_is_deleted_are_gone() -> None:
    assert told(seen()) == (TALKER,)


def test_nodes_of_a_pod_that_has_ended_are_gone() -> None:
    assert told(seen(pod(ip=TALKER, phase="Succeeded"))) == (TALKER,)


def test_nodes_of_a_pod_that_is_about_to_end_are_not_gone_yet() -> None:
    assert told(seen(pod(ip=TALKER, deleting=True))) == ()


def test_it_is_told_until_the_proxy_does_not_name_them_any_more() -> None:
    first = find_departures(seen(), KNOWN, 1.0)
    second = find_departures(seen(), first.state, 2.0)
    assert first.addresses == second.addresses == {PROXY: (TALKER,)}
    assert (
        TALKER
        in find_departures(seen(), first.state, 2 * GONE_ADDRESS_KEPT_S).state.addresses["one"]
    )
    third = find_departures(seen(names=()), second.state, 3.0)
    assert third.addresses == {}
    fourth = find_departures(seen(names=()), third.state, GONE_ADDRESS_KEPT_S)
    assert TALKER not in fourth.state.addresses["one"]


def test_a_node_that_has_registered_just_before_its_pod_went_is_told() -> None:
    """The proxy's answer with the node comes after the look that finds the pod gone."""
    unnamed = seen(names=())
    second = find_departures(unnamed, KNOWN, 3.0)
    assert list(next_checks(second, 3.0)) == [DEPARTURE_RECHECK_S]
    assert find_departures(seen(), second.state, 6.0).addresses == {PROXY: (TALKER,)}


def test_the_controller_looks_again_until_it_is_told_no_more() -> None:
    first = find_departures(seen(), KNOWN, 1.0)
    assert list(next_checks(first, 1.0)) == [DEPARTURE_RECHECK_S]
    quiet = find_departures(seen(pod(ip=TALKER)), KNOWN, 1.0)
    assert list(next_checks(quiet, 1.0)) == []


def test_a_pod_that_got_the_address_of_another_one_is_not_gone() -> None:
    assert told(seen(pod("other", ip=TALKER))) == ()


def test_an_address_on_another_node_counts_as_nobodys_here() -> None:
    nodes = [node("one"), node("two")]
    assert told(seen(*nodes, pod("far", "two", ip=TALKER))) == (TALKER,)


def test_a_pod_may_run_before_its_address_is_known() -> None:
    starting = seen(pod(ip="", phase="Pending"), names=(TALKER,))
    first = find_departures(starting, ClusterState(), 0.0)
    assert first.addresses == {}
    assert find_departures(starting, first.state, UNKNOWN_ADDRESS_GRACE_S + 1).addresses == {}
    assert (
        find_departures(seen(pod(ip=TALKER)), first.state, UNKNOWN_ADDRESS_GRACE_S + 1).addresses
        == {}
    )


def test_after_a_restart_addresses_in_the_pod_network_are_given_up_after_a_while() -> None:
    first = find_departures(seen(), ClusterState(), 0.0)
    assert first.addresses == {}
    assert find_departures(seen(), first.state, UNKNOWN_ADDRESS_GRACE_S - 1).addresses == {}
    assert find_departures(seen(), first.state, UNKNOWN_ADDRESS_GRACE_S).addresses == {
        PROXY: (TALKER,)
    }


def test_the_controller_looks_again_when_that_while_is_over() -> None:
    again = look(seen(names=(TALKER,)), now=0.0)
    assert again.state.strange == {("one", TALKER): 0.0}
    later = look(seen(names=(TALKER,)), again.state, UNKNOWN_ADDRESS_GRACE_S - 0.5)
    assert later.next_look_in == 0.5
    last = look(seen(names=(TALKER,)), later.state, UNKNOWN_ADDRESS_GRACE_S)
    assert last.briefings[PROXY].gone == (TALKER,)


def test_what_is_outside_the_pod_network_is_left_alone() -> None:
    both = node(pod_networks=("10.244.1.0/24", "fd00::/64"))  # pods are listed with IPv4
    stranger = seen(both, names=("192.0.2.99", "no address", "fd00::7"))
    first = find_departures(stranger, ClusterState(), 0.0)
    assert first.state.strange == {}
    assert find_departures(stranger, first.state, 100.0).addresses == {}


def test_without_a_known_pod_network_only_what_was_a_pods_is_gone() -> None:
    bare = seen(node(pod_networks=()), names=(TALKER, LISTENER))
    first = find_departures(bare, KNOWN, 0.0)
    assert first.addresses == {PROXY: (TALKER,)}
    assert find_departures(bare, first.state, 100.0).addresses == {PROXY: (TALKER,)}


def test_a_node_that_is_not_ready_is_not_judged() -> None:
    """Pods that were deleted by force may run there still."""
    assert told(seen(node(ready=False))) == ()


def test_pods_in_the_nodes_own_network_are_no_reason_to_call_its_address_gone() -> None:
    memory = remembering(pod("host", ip="192.0.2.1", host_network=True))
    assert told(seen(names=("192.0.2.1",)), memory) == ()


def test_a_proxy_that_does_not_answer_is_told_nothing_and_nothing_is_forgotten() -> None:
    silent = seen(reports={PROXY: ProxyReport(False, error="refused")})
    departures = find_departures(silent, KNOWN, 1.0)
    assert departures.addresses == {}
    assert TALKER in departures.state.addresses["one"]
    unasked = find_departures(replace(silent, reports={}), departures.state, 2.0)
    assert find_departures(seen(), unasked.state, 3.0).addresses == {PROXY: (TALKER,)}
