"""Which addresses a proxy is told to be gone: never one at which something runs."""

from typing import Any

from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.departures import AGAIN, REMEMBERED, UNSEEN, gone, waits
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, ProxyReport
from tests.unit.operator.kubernetes.objects import look, node, observed, pod, proxy, rosproxy

PROXY = "uid-proxy-robot-one"
TALKER, LISTENER = "10.244.1.7", "10.244.1.8"


def seen(*things: Any, names: tuple[str, ...] = (TALKER,), **more: Any) -> ClusterSnapshot:
    answer = ProxyReport(True, True, nodes=dict.fromkeys(names, ("/a",)))
    return observed(rosproxy(), proxy(), *things, **{"reports": {PROXY: answer}} | more)


def remembering(*things: Any) -> ClusterState:
    return gone(seen(*things), ClusterState(), 0.0).state


KNOWN = remembering(pod(ip=TALKER))


def told(
    observed_: ClusterSnapshot, memory: ClusterState = KNOWN, now: float = 1.0
) -> tuple[str, ...]:
    return gone(observed_, memory, now).gone.get(PROXY, ())


def test_nodes_of_a_pod_that_runs_are_not_gone() -> None:
    assert told(seen(pod(ip=TALKER))) == ()


def test_nodes_of_a_pod_that_is_deleted_are_gone() -> None:
    assert told(seen()) == (TALKER,)


def test_nodes_of_a_pod_that_has_ended_are_gone() -> None:
    assert told(seen(pod(ip=TALKER, phase="Succeeded"))) == (TALKER,)


def test_nodes_of_a_pod_that_is_about_to_end_are_not_gone_yet() -> None:
    assert told(seen(pod(ip=TALKER, deleting=True))) == ()


def test_it_is_told_until_the_proxy_does_not_name_them_any_more() -> None:
    first = gone(seen(), KNOWN, 1.0)
    second = gone(seen(), first.state, 2.0)
    assert first.gone == second.gone == {PROXY: (TALKER,)}
    assert TALKER in gone(seen(), first.state, 2 * REMEMBERED).state.addresses["one"]
    third = gone(seen(names=()), second.state, 3.0)
    assert third.gone == {}
    fourth = gone(seen(names=()), third.state, REMEMBERED)
    assert TALKER not in fourth.state.addresses["one"]


def test_a_node_that_has_registered_just_before_its_pod_went_is_told() -> None:
    """The answer in which it is named comes after the look that finds the pod gone."""
    unnamed = seen(names=())
    second = gone(unnamed, KNOWN, 3.0)
    assert list(waits(second, 3.0)) == [AGAIN]
    assert gone(seen(), second.state, 6.0).gone == {PROXY: (TALKER,)}


def test_the_controller_looks_again_until_it_is_told_no_more() -> None:
    first = gone(seen(), KNOWN, 1.0)
    assert list(waits(first, 1.0)) == [AGAIN]
    quiet = gone(seen(pod(ip=TALKER)), KNOWN, 1.0)
    assert list(waits(quiet, 1.0)) == []


def test_a_pod_that_got_the_address_of_another_one_is_not_gone() -> None:
    assert told(seen(pod("other", ip=TALKER))) == ()


def test_an_address_on_another_node_counts_as_nobodys_here() -> None:
    there = [node("one"), node("two")]
    assert told(seen(*there, pod("far", "two", ip=TALKER))) == (TALKER,)


def test_a_pod_may_run_before_its_address_is_known() -> None:
    starting = seen(pod(ip="", phase="Pending"), names=(TALKER,))
    first = gone(starting, ClusterState(), 0.0)
    assert first.gone == {}
    assert gone(starting, first.state, UNSEEN + 1).gone == {}
    assert gone(seen(pod(ip=TALKER)), first.state, UNSEEN + 1).gone == {}


def test_after_a_restart_addresses_in_the_pod_network_are_given_up_after_a_while() -> None:
    first = gone(seen(), ClusterState(), 0.0)
    assert first.gone == {}
    assert gone(seen(), first.state, UNSEEN - 1).gone == {}
    assert gone(seen(), first.state, UNSEEN).gone == {PROXY: (TALKER,)}


def test_the_controller_looks_again_when_that_while_is_over() -> None:
    again = look(seen(names=(TALKER,)), now=0.0)
    assert again.state.strange == {("one", TALKER): 0.0}
    later = look(seen(names=(TALKER,)), again.state, UNSEEN - 0.5)
    assert later.again_in == 0.5
    assert look(seen(names=(TALKER,)), later.state, UNSEEN).gone == {PROXY: (TALKER,)}


def test_what_is_outside_the_pod_network_is_left_alone() -> None:
    both = node(pod_networks=("10.244.1.0/24", "fd00::/64"))  # pods are listed with IPv4
    stranger = seen(both, names=("192.0.2.99", "no address", "fd00::7"))
    first = gone(stranger, ClusterState(), 0.0)
    assert first.state.strange == {}
    assert gone(stranger, first.state, 100.0).gone == {}


def test_without_a_known_pod_network_only_what_was_a_pods_is_gone() -> None:
    bare = seen(node(pod_networks=()), names=(TALKER, LISTENER))
    first = gone(bare, KNOWN, 0.0)
    assert first.gone == {PROXY: (TALKER,)}
    assert gone(bare, first.state, 100.0).gone == {PROXY: (TALKER,)}


def test_a_node_that_is_not_ready_is_not_judged() -> None:
    """Pods that were deleted by force may run there still."""
    assert told(seen(node(ready=False))) == ()


def test_pods_in_the_nodes_own_network_are_no_reason_to_call_its_address_gone() -> None:
    memory = remembering(pod("host", ip="192.0.2.1", host_network=True))
    assert told(seen(names=("192.0.2.1",)), memory) == ()


def test_a_proxy_that_does_not_answer_is_told_nothing_and_nothing_is_forgotten() -> None:
    silent = seen(reports={PROXY: ProxyReport(False, error="refused")})
    found = gone(silent, KNOWN, 1.0)
    assert found.gone == {}
    assert TALKER in found.state.addresses["one"]
    unasked = gone(replace(silent, reports={}), found.state, 2.0)
    assert gone(seen(), unasked.state, 3.0).gone == {PROXY: (TALKER,)}
