"""The wanted proxies, with networks, names and numbers of ports."""

import re
from dataclasses import replace
from typing import Any

import pytest

from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.aliases import Naming, assign_aliases
from rosproxy_operator.docker.planner.desired import desire
from rosproxy_operator.docker.planner.model import Container, Desired, HostState, Network
from rosproxy_operator.docker.planner.specs import proxy_name
from rosproxy_operator.docker.planner.state import DockerMemory, with_exited
from rosproxy_operator.docker.planner.taken_names import FormerNames
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import Master, Place
from tests.unit.operator.docker.builders import (
    APP,
    ENABLED,
    HERE,
    PLACE,
    SETTINGS,
    UPLINK,
    attachment,
    both,
    container,
    observed,
    read_members,
    sandbox,
)

ARM = Place(Master("http://arm:11311"), HERE)
ON_ARM = {**ENABLED, "rosproxy.master-uri": ARM.master.uri}
LAB = Network("n2", "lab")
NAME = proxy_name(PLACE)


def want(
    seen: HostState,
    memory: DockerMemory | None = None,
    now: float = 0.0,
    settings: PlanSettings = SETTINGS,
) -> tuple[dict[Place, Desired], tuple[Problem, ...]]:
    members, _ = read_members(seen, settings)
    memory = with_exited(memory or DockerMemory(), members, now)
    desired, problems = desire(seen, settings, members, memory, now)
    assert list(desired) == sorted(desired, key=lambda proxy: proxy.place)
    return {proxy.place: proxy for proxy in desired}, problems


def named(
    seen: HostState,
    settings: PlanSettings = SETTINGS,
    former: FormerNames | None = None,
) -> Naming:
    return assign_aliases(
        [*want(seen, settings=settings)[0].values()], seen, settings, former or {}
    )


def names(
    *containers: Container, **more: Any
) -> tuple[dict[tuple[Place, str], set[str]], list[str]]:
    """The names of proxies on networks, and the containers that do not find their proxy."""
    seen = observed(*containers, **more)
    naming = named(seen)
    told = [problem.subject.removeprefix("container ") for problem in naming.problems]
    found = {
        (place, network): set(aliases)
        for place, by_network in naming.aliases.items()
        for network, aliases in by_network.items()
    }
    return found, told


# groups


def test_one_proxy_for_all_who_mean_the_same() -> None:
    labels = {**ENABLED, "rosproxy.ports": "40"}
    seen = observed(
        container("a"),
        container("b", labels, ("lab",)),
        container("c", ON_ARM),
        networks=(UPLINK, APP, LAB),
    )
    desired, problems = want(seen)
    assert problems == ()
    assert [member.container.name for member in desired[PLACE].members] == ["a", "b"]
    assert (desired[PLACE].networks, desired[PLACE].ports) == (frozenset({"app", "lab"}), 40)
    assert (desired[ARM].networks, desired[ARM].ports) == (frozenset({"app"}), 32)


def test_the_option_is_the_least_number_of_ports() -> None:
    seen = observed(container(labels={**ENABLED, "rosproxy.ports": "8"}))
    assert want(seen)[0][PLACE].ports == 32
    assert want(seen, settings=replace(SETTINGS, ports=4))[0][PLACE].ports == 8


def test_a_proxy_that_nobody_wants_is_listed_too() -> None:
    desired, _ = want(observed(**both()))
    assert desired[PLACE] == Desired(PLACE, False, 32)


def test_a_network_that_is_gone_is_dropped() -> None:
    desired, problems = want(observed(container(networks=("app", "gone"))))
    assert (desired[PLACE].networks, problems) == (frozenset({"app"}), ())
    desired, problems = want(observed(container(networks=("gone",))))
    assert (desired[PLACE].live, problems) == (False, ())


EARLY = [Network("n3", name) for name in ("0-app", "0-app_default", "0")]
LATER = [Network("n3", name) for name in ("00", "0-zoo", "Lab", "_x", "1")]


@pytest.mark.parametrize("network", [*EARLY, *LATER, Network("n3", "0-app", internal=True)])
def test_a_network_that_would_take_the_published_ports_is_not_joined(network: Network) -> None:
    """Its name sorts before the uplink. An internal network takes no ports."""
    talker = container(networks=("app", network.name))
    desired, problems = want(observed(talker, networks=(UPLINK, APP, network)))
    if network not in EARLY:
        assert desired[PLACE].networks == {"app", network.name}
        assert problems == ()
        return
    assert desired[PLACE].networks == {"app"}
    assert [problem.subject for problem in problems] == [f"network {network.name}"]
    assert "its name sorts before the name of the uplink network 0-rosproxy" in problems[0].message


def test_a_network_with_ipv6_takes_the_ports_of_an_uplink_without() -> None:
    """The engine prefers such a network, whatever its name. The proxy works there nevertheless."""
    app = replace(APP, dual_stack=True)
    desired, problems = want(observed(container(), networks=(UPLINK, app)))
    assert desired[PLACE].networks == {"app"}
    assert [(problem.subject, problem.fatal) for problem in problems] == [("network app", False)]
    assert "the network has IPv6, and the uplink network 0-rosproxy does not" in problems[0].message
    internal = replace(app, internal=True)
    uplink = replace(UPLINK, dual_stack=True)
    for networks in ((UPLINK, internal), (uplink, app)):
        assert want(observed(container(), networks=networks))[1] == ()


def test_an_early_network_without_ipv6_takes_no_ports_of_an_uplink_with_ipv6() -> None:
    uplink = replace(UPLINK, dual_stack=True)
    early = Network("n3", "0-app")
    desired, problems = want(observed(container(networks=("0-app",)), networks=(uplink, early)))
    assert (desired[PLACE].networks, problems) == (frozenset({"0-app"}), ())


def test_an_early_network_that_nobody_asks_for_is_no_problem() -> None:
    assert want(observed(container(), networks=(UPLINK, APP, Network("n3", "0-a"))))[1] == ()


# exited containers


def test_networks_of_who_has_exited_stay_joined_for_the_grace() -> None:
    gone = container("b", networks=("lab",), state="exited")
    sandboxes = [sandbox(networks=("app", "lab"))]
    seen = observed(container("a"), gone, networks=(UPLINK, APP, LAB), sandboxes=sandboxes)
    assert want(seen)[0][PLACE].networks == {"app", "lab"}
    since = DockerMemory(exited={gone.id: 0.0})
    assert want(seen, since, 59.0)[0][PLACE].networks == {"app", "lab"}
    assert want(seen, since, 60.0)[0][PLACE].networks == {"app"}


def test_who_has_exited_joins_nothing_and_keeps_no_proxy() -> None:
    gone = container("b", networks=("lab",), state="exited")
    networks = (UPLINK, APP, LAB)
    desired, _ = want(observed(container("a"), gone, networks=networks, sandboxes=[sandbox()]))
    assert desired[PLACE].networks == {"app"}
    desired, _ = want(observed(gone, networks=networks, sandboxes=[sandbox(networks=("lab",))]))
    assert (desired[PLACE].live, desired[PLACE].networks) == (False, frozenset({"lab"}))


# names


def test_a_proxy_has_three_names() -> None:
    assert names(container()) == ({(PLACE, "app"): {"rosproxy", "robot", NAME}}, [])


def test_a_master_that_is_an_address_gives_no_name() -> None:
    labels = {**ENABLED, "rosproxy.master-uri": "http://192.0.2.7:11311"}
    given, told = names(container(labels=labels))
    assert told == []
    assert [len(aliases) for aliases in given.values()] == [2]


def test_a_masters_name_that_another_container_has_is_not_taken() -> None:
    robot = container("robot", {}, [attachment("app", "Robot")])
    assert names(container(), robot) == ({(PLACE, "app"): {"rosproxy", NAME}}, [])


def test_who_looks_for_the_masters_name_then_is_told() -> None:
    robot = container("robot", {}, state="exited")
    seen = observed(container(env=PLACE.master.uri), robot)
    assert named(seen).problems == (
        Problem(
            "container talker",
            "the nodes look for the proxy by the name robot, but on network app that name belongs "
            "to container robot. So the nodes bypass the proxy",
            "Set ROS_MASTER_URI=http://rosproxy:11311",
            fatal=False,
            reason="NameTaken",
        ),
    )


@pytest.mark.parametrize(
    "robot",
    [
        container("robot", {}, state="dead"),
        container("robot", {}, state="removing"),
        container("robot", {}, ("lab",)),
    ],
    ids=["dead", "removing", "on another network"],
)
def test_a_name_that_nobody_has_there_is_free(robot: Container) -> None:
    assert names(container(), robot)[0] == {(PLACE, "app"): {"rosproxy", "robot", NAME}}


def test_a_proxy_made_by_hand_keeps_its_name() -> None:
    by_hand = container("rosproxy", {})
    given, told = names(container("a"), container("b", env=PLACE.master.uri), by_hand)
    assert (given, told) == ({(PLACE, "app"): {"robot", NAME}}, ["a"])


def test_of_two_proxies_on_a_network_one_is_called_rosproxy() -> None:
    given, told = names(
        container("a"), container("b", ON_ARM), container("c", ON_ARM, env=ARM.master.uri)
    )
    assert given == {
        (ARM, "app"): {"arm", "rosproxy", proxy_name(ARM)},
        (PLACE, "app"): {"robot", NAME},
    }
    assert told == ["a"]


def test_the_one_whose_containers_look_for_it() -> None:
    given, told = names(container("a"), container("b", ON_ARM, env=ARM.master.uri))
    assert (given[PLACE, "app"], told) == ({"rosproxy", "robot", NAME}, [])
    assert given[ARM, "app"] == {"arm", proxy_name(ARM)}


def test_the_one_who_has_it_keeps_it() -> None:
    seen: Any = {"sandboxes": [sandbox(), sandbox(ARM, networks=())]}
    given, told = names(container("a"), container("b", ON_ARM), **seen)
    assert given[PLACE, "app"] == {"rosproxy", "robot", NAME}
    assert told == ["b"]


def test_the_one_who_lingers_keeps_it_as_long() -> None:
    left = container("old", ON_ARM, state="exited")
    given, told = names(container("a"), left, sandboxes=[sandbox(ARM)])
    assert (given[PLACE, "app"], told) == ({"robot", NAME}, ["a"])


@pytest.mark.parametrize(
    ("sandboxes", "has_it", "told"),
    [
        ([sandbox(ARM)], True, []),
        ([sandbox(ARM, state="restarting")], False, ["a"]),
        ([sandbox(ARM, state="restarting"), sandbox()], True, ["a"]),
    ],
    ids=["leaves", "can't leave now", "can't leave now, but the other proxy has the name, too"],
)
def test_an_unneeded_proxy_keeps_its_name_until_it_has_left(
    sandboxes: list, has_it: bool, told: list[str]
) -> None:
    """A proxy that the engine restarts answers again soon. Then both proxies would answer."""
    given, told_names = names(container("a"), sandboxes=sandboxes)
    assert (("rosproxy" in given[PLACE, "app"]), told_names) == (has_it, told)
    assert given[PLACE, "app"] >= {"robot", NAME}


def test_two_masters_on_one_host() -> None:
    """Only one proxy can have the name robot. The containers of the other get a problem."""
    second = Place(Master("http://robot:11312"), HERE)
    labels = {**ENABLED, "rosproxy.master-uri": second.master.uri}
    given, told = names(
        container("a", env=PLACE.master.uri),
        container("b", labels, env=second.master.uri),
        container("c", labels, env=f"http://{proxy_name(second)}:11312"),
    )
    assert given[PLACE, "app"] == {"rosproxy", "robot", NAME}
    assert given[second, "app"] == {proxy_name(second)}
    assert told == ["b"]


@pytest.mark.parametrize("mode", [APP.name, APP.id])
def test_container_that_is_just_being_created_has_its_network_soon(mode: str) -> None:
    """For a moment the engine lists the container without a network."""
    seen = observed(container(networks=(), state="created", mode=mode))
    members, problems = read_members(seen, SETTINGS)
    assert [member.networks for member in members] == [{APP.name}]
    assert not problems


WRONG = Place(Master("http://robot:11312"), HERE)
ADVICE = re.compile(r"set ROS_MASTER_URI=(\S+)(?: and the label (\S+)=(\S+))?$")


def test_an_earlier_container_with_a_wrong_port_is_named_in_the_problem() -> None:
    """The wrong container's proxy has the name of the master's host."""
    bare = {"rosproxy.enable": "true"}
    bad = container("bad", bare, env=WRONG.master.uri)
    seen = observed(bad, container("good", bare, env=PLACE.master.uri), sandboxes=[sandbox(WRONG)])
    problems = named(seen).problems
    assert [problem.subject for problem in problems] == ["container good"]
    assert problems[0].message == (
        "the nodes look for the proxy by the name robot, but on network app that name belongs to "
        f"proxy {proxy_name(WRONG)} (for the master {WRONG.master.uri} of bad). So the nodes "
        f"bypass the proxy. Set ROS_MASTER_URI=http://{NAME}:11311 and the label "
        f"rosproxy.master-uri={PLACE.master.uri}"
    )


@pytest.mark.parametrize("env", [PLACE.master.uri, "http://rosproxy:11311"])
@pytest.mark.parametrize("labels", [ENABLED, {"rosproxy.enable": "true"}])
@pytest.mark.parametrize(
    "neighbours",
    [
        {"containers": [container("robot", {})]},
        {"containers": [container("robot", {}), container("rosproxy", {})]},
        {"containers": [container("b", {"rosproxy.enable": "true"}, env=WRONG.master.uri)],
         "sandboxes": [sandbox(WRONG)]},
    ],
)  # fmt: skip
def test_who_follows_the_advice_is_told_nothing_more(
    env: str, labels: dict[str, str], neighbours: dict[str, Any]
) -> None:
    settings = replace(SETTINGS, master_uri=PLACE.master.uri)
    others = neighbours["containers"]
    more = {"sandboxes": neighbours.get("sandboxes", [])}

    def told(talker: Container) -> list[str]:
        seen = observed(talker, *others, **more)
        members, problems = read_members(seen, settings)
        problems += named(seen, settings).problems
        assert PLACE in {m.place for m in members if m.container.name == "talker"}
        return [p.message for p in problems if p.subject == "container talker"]

    texts = told(container(labels=labels, env=env))
    assert texts or env != PLACE.master.uri
    for text in texts:
        if advice := ADVICE.search(text):
            uri, label, value = advice.groups()
            cured = {**labels, label: value} if label else labels
            assert told(container(labels=cured, env=uri)) == []
