"""Updates to a proxy about the containers on its networks."""

from dataclasses import replace
from ipaddress import IPv4Network

from rosproxy.shared.ports import PortRange
from rosproxy_operator.docker.planner.model import (
    Attachment,
    Container,
    HostState,
    Member,
    Network,
    Proxy,
    Sandbox,
)
from rosproxy_operator.docker.planner.proxy_update import (
    AddressHistory,
    NetworkFacts,
    ProxyUpdate,
    network_facts,
)
from rosproxy_operator.proxy_spec.place import Master, Place

PLACE = Place(Master("http://robot:11311"), "192.0.2.10")
PORTS = PortRange(11400, 11431)
SUBNET = IPv4Network("172.18.0.0/16")


def at(address: str, network: str = "app", *names: str) -> Attachment:
    return Attachment(network, address, frozenset(names), endpoint="e1")


def talker(address: str = "172.18.0.5", state: str = "running") -> Container:
    return Container("t" * 20, "talker", state, attachments=(at(address),), hostname="bhost")


def look(*containers: Container) -> HostState:
    home = Container(
        "box", "box", "running", attachments=(at("172.30.0.2", "up"), at("172.18.0.2"))
    )
    process = Container("p", "p", "running", network_mode="container:box")
    networks = (
        Network("1", "app", gateway="172.18.0.1", subnets=(SUBNET,)),
        Network("2", "up", gateway="172.30.0.1"),
        Network("3", "other", gateway="172.19.0.1", subnets=(IPv4Network("172.19.0.0/16"),)),
    )
    return HostState(
        containers,
        networks,
        (Proxy(PLACE, process, PORTS, ""),),
        PORTS,
        sandboxes=(Sandbox(PLACE, home, PORTS, ""),),
        addresses=frozenset({"172.18.0.5", "172.18.0.2", "172.30.0.2"}),
    )


def told(seen: HostState, *members: Member) -> NetworkFacts:
    return network_facts(replace(seen, masters={"robot": "198.51.100.7"}), seen.proxies[0], members)


def member(container: Container) -> Member:
    return Member(container, PLACE)


def test_a_running_container_has_arrived_under_all_its_names() -> None:
    container = replace(talker(), attachments=(at("172.18.0.5", "app", "web", "bad name"),))
    (arrival,) = told(look(container), member(container)).arrivals
    assert (arrival.address, arrival.network, arrival.endpoint) == ("172.18.0.5", "app", "e1")
    assert arrival.names == {"talker", "t" * 12, "web", "bhost"}


def test_only_those_that_run_and_want_this_proxy_arrive() -> None:
    other = Member(talker(), Place(Master("http://other:11311"), "192.0.2.10"))
    exited = talker(state="exited")
    assert not told(look(talker()), other).arrivals
    assert not told(look(exited), member(exited)).arrivals
    assert not told(look(talker())).arrivals


def test_networks_that_the_proxy_is_not_on_do_not_count() -> None:
    away = replace(talker(), attachments=(at("172.19.0.5", "other"),))
    facts = told(look(away), member(away))
    assert not facts.arrivals
    assert not facts.addresses
    assert facts.subnets == (SUBNET,)


def test_a_container_in_anothers_network_arrives_at_its_address() -> None:
    guest = Container("g" * 20, "guest", "running", network_mode=f"container:{'t' * 20}")
    (arrival,) = told(look(talker(), guest), member(guest)).arrivals
    assert (arrival.container, arrival.address, arrival.endpoint) == ("g" * 20, "172.18.0.5", "e1")
    assert {"guest", "bhost"} <= arrival.names


def test_the_masters_address_is_only_told_for_a_name() -> None:
    assert told(look()).master_address == "198.51.100.7"
    seen = replace(look(), masters={"198.51.100.8": "198.51.100.8"})
    place = Place(Master("http://198.51.100.8:11311"), "192.0.2.10")
    process = replace(seen.proxies[0], place=place)
    assert network_facts(seen, process, ()).master_address == ""


def test_selected_are_all_that_may_use_it_on_its_networks() -> None:
    """Also starting containers, and containers in the network of another container."""
    starting = Container("s" * 20, "soon", "created", attachments=(at("172.18.0.7"),))
    ended = Container("e" * 20, "ended", "exited", attachments=(at("172.18.0.8"),))
    pod = Container("q" * 20, "pod", "running", attachments=(at("172.18.0.9"),))
    guest = Container("g" * 20, "guest", "running", network_mode=f"container:{'q' * 20}")
    away = Container("a" * 20, "away", "running", attachments=(at("172.19.0.5", "other"),))
    plain = Container("n" * 20, "plain", "running", attachments=(at("172.18.0.10"),))
    others = Container("o" * 20, "others", "running", attachments=(at("172.18.0.11"),))
    seen = look(talker(), starting, ended, pod, guest, away, plain, others)
    members = [member(container) for container in (talker(), starting, ended, guest, away)]
    facts = told(seen, *members, Member(others, Place(Master("http://other:11311"), "192.0.2.10")))
    assert facts.selected == {"172.18.0.5", "172.18.0.7", "172.18.0.9"}


def test_gone_are_addresses_of_nobody_on_its_networks() -> None:
    nodes = {"172.18.0.5", "172.18.0.6", "172.18.0.1", "10.0.0.9", "talker"}
    for facts, addresses in (
        (told(look(talker())), {"gone": ["172.18.0.6"]}),
        (replace(told(look(talker())), subnets=()), {}),
    ):
        update = ProxyUpdate()
        update.record(facts, 0.0)
        assert update.body(nodes, 0.0) == addresses


OLD = "172.18.0.5"
NEW = "172.18.0.9"
HERE, AWAY, THERE, NOBODY = (
    told(look(*containers))
    for containers in (
        [talker()],
        [replace(talker(), attachments=())],
        [talker(NEW)],
        [],
    )
)


def history_of(*looks: tuple[float, NetworkFacts]) -> AddressHistory:
    history = AddressHistory()
    for when, facts in looks:
        history.record(facts, when)
    return history


def test_a_container_with_another_address_has_moved_until_its_proxy_knows() -> None:
    history = history_of((0.0, HERE), (1.0, THERE))
    assert history.moved({OLD}) == {OLD: NEW}
    assert history.moved({NEW}) == {}
    assert history.reserved_addresses == {OLD}
    assert history.next_expiry == 6.0


def test_a_move_is_given_up_in_the_end() -> None:
    history = history_of((0.0, HERE), (1.0, THERE), (6.0, THERE))
    assert not history.moved({OLD})
    assert not history.reserved_addresses
    assert history.next_expiry is None


def test_a_container_off_the_network_for_a_moment_may_come_back_elsewhere() -> None:
    history = history_of((0.0, HERE), (1.0, AWAY))
    assert not history.moved({OLD})
    assert history.reserved_addresses == {OLD}
    assert history.next_expiry == 3.0
    history.record(THERE, 2.0)
    assert history.moved({OLD}) == {OLD: NEW}


def test_a_container_that_stays_away_is_gone() -> None:
    assert history_of((0.0, HERE), (1.0, AWAY), (3.0, AWAY)).reserved_addresses == frozenset()


def test_a_container_that_does_not_run_is_gone_at_once() -> None:
    history = history_of((0.0, HERE), (1.0, NOBODY))
    assert not history.reserved_addresses
    assert history.next_expiry is None


def test_an_address_that_another_container_has_now_is_not_told_as_moved() -> None:
    other = Container("o", "other", "running", attachments=(at(OLD),))
    history = history_of((0.0, HERE), (1.0, told(look(talker(NEW), other))))
    assert history.moved({OLD}) == {}


def test_container_that_changes_networks_takes_its_nodes_along() -> None:
    before = NetworkFacts(addresses={("t", "app"): "172.18.0.5"}, running=frozenset("t"))
    between = NetworkFacts(running=frozenset("t"))
    after = NetworkFacts(addresses={("t", "other"): "172.19.0.9"}, running=frozenset("t"))

    history = history_of((0.0, before), (0.1, between), (1.0, after))

    assert history.moved({"172.18.0.5"}) == {"172.18.0.5": "172.19.0.9"}
    assert history.reserved_addresses == {"172.18.0.5"}
    history.record(replace(after, addresses={("t", "other"): "172.19.0.3"}), 1.5)
    assert history.moved({"172.19.0.9"}) == {"172.19.0.9": "172.19.0.3"}


def test_container_that_leaves_one_of_two_networks_is_found_on_the_other() -> None:
    app = ("t", "app")
    other = ("t", "other")
    both = NetworkFacts(addresses={app: "172.18.0.5", other: "172.19.0.9"}, running=frozenset("t"))
    after = replace(both, addresses={other: "172.19.0.9"})

    assert history_of((0.0, both), (0.1, after)).moved({"172.18.0.5"}) == {
        "172.18.0.5": "172.19.0.9"
    }


def test_an_arrival_is_told_again_until_its_nodes_had_time_to_register() -> None:
    update = ProxyUpdate()
    assert update.next_due(0.0) is None
    update.record(told(look(talker()), member(talker())), 0.0)
    (arrived,) = update.body(set(), 0.0)["arrived"]
    assert arrived["address"] == OLD
    assert "talker" in arrived["names"]
    update.mark_delivered(0.0)
    assert update.next_due(0.0) == 1.0
    assert update.body(set(), 0.5) == {}
    for when in (1.0, 3.0, 10.0):
        update.record(told(look(talker()), member(talker())), when)
        assert update.body(set(), when)["arrived"]
        update.mark_delivered(when)
    assert update.next_due(11.0) is None


def test_what_was_not_heard_is_told_again() -> None:
    update = ProxyUpdate()
    update.record(told(look(talker()), member(talker())), 0.0)
    assert update.body(set(), 0.0)["arrived"]
    assert update.next_due(0.1) == 0.0
    assert update.body(set(), 0.1)["arrived"]


def test_nodes_of_a_container_that_is_no_more_are_gone() -> None:
    update = ProxyUpdate()
    update.record(HERE, 0.0)
    assert update.body({OLD}, 0.0) == {}
    update.record(replace(NOBODY, taken=frozenset(), subnets=()), 1.0)
    assert update.body({OLD}, 1.0) == {"gone": [OLD]}  # also on a network that the proxy has left


def test_a_move_is_told_until_the_proxy_knows() -> None:
    update = ProxyUpdate()
    update.record(HERE, 0.0)
    update.body({OLD}, 0.0)
    update.record(replace(THERE, taken=frozenset({NEW})), 1.0)  # the old is free, but moved
    assert update.body({OLD}, 1.0) == {"moved": {OLD: NEW}}
    update.mark_delivered(1.0)
    assert update.next_due(1.0) == 1.0
    assert update.body({NEW}, 2.0) == {}
