"""ROS 2 containers by label: the proxy that a container gets, and problems."""

from collections.abc import Mapping
from dataclasses import replace
from ipaddress import IPv4Network

import pytest

from rosproxy.shared.policy.rules import parse_rules
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.common.ros2_variables import ROS2_VARIABLES
from rosproxy_operator.docker.option_values import read_host_pattern
from rosproxy_operator.docker.planner.labels.members import master_hosts, read_labels
from rosproxy_operator.docker.planner.model import Container, Member, Network
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import Domain, Place
from tests.unit.operator.docker.builders import (
    HERE,
    PLACE,
    ROBOT,
    SETTINGS,
    UPLINK,
    container,
    observed,
    read_members,
)

ON = {"rosproxy.enable": "true"}
TWO = {**ON, "rosproxy.ros": "2"}
DOMAIN = Place(Domain(0), HERE)
STATIC_PEERS = "ROS_STATIC_PEERS"


def labelled_container(
    labels: Mapping[str, str] | None = None,
    variables: Mapping[str, str] | None = None,
    env: str = "",
) -> Container:
    return replace(container(labels=labels or ON, env=env), variables=variables or {})


def read(
    container: Container, settings: PlanSettings = SETTINGS, **more
) -> tuple[list[Member], list[str]]:
    """The members of a container, and the texts of its problems."""
    members, problems = read_members(observed(container, **more), settings)
    return list(members), [problem.message for problem in problems]


def places(container: Container, settings: PlanSettings = SETTINGS) -> list[Place]:
    return [member.place for member in read(container, settings)[0]]


def refusal(container: Container, settings: PlanSettings = SETTINGS) -> str:
    members, problems = read_members(observed(container), settings)
    assert not members
    assert [type(problem) for problem in problems] == [Problem]
    assert problems[0].fatal
    return problems[0].message


@pytest.mark.parametrize(
    "variables",
    [{"ROS_VERSION": "2"}, {"ROS_DISTRO": "jazzy"}, {"ROS_DISTRO": "not yet thought of"}],
)
def test_its_variables_say_that_it_is_of_ros_2(variables: Mapping[str, str]) -> None:
    assert read(labelled_container(variables=variables)) == (
        [Member(labelled_container(variables=variables), DOMAIN, networks=frozenset({"app"}))],
        [],
    )


@pytest.mark.parametrize(
    "variables", [{"ROS_VERSION": "1"}, {"ROS_DISTRO": "noetic"}, {"ROS_DISTRO": "Melodic"}]
)
def test_its_variables_say_that_it_is_of_ros_1(variables: Mapping[str, str]) -> None:
    assert places(labelled_container({**ON, "rosproxy.master-uri": ROBOT}, variables)) == [PLACE]


def test_the_label_says_it_whatever_the_variables_say() -> None:
    labels = {**ON, "rosproxy.ros": "1", "rosproxy.master-uri": ROBOT}
    assert places(labelled_container(labels, {"ROS_VERSION": "2"})) == [PLACE]
    assert places(labelled_container(TWO, {"ROS_DISTRO": "noetic"})) == [DOMAIN]
    assert "is none of 1, 2 and 1,2" in refusal(labelled_container({**ON, "rosproxy.ros": "foxy"}))


def test_a_container_with_both_versions_gets_both() -> None:
    labels = {**ON, "rosproxy.ros": "1,2", "rosproxy.master-uri": ROBOT, "rosproxy.ports": "40"}
    members, told = read(labelled_container(labels, env=ROBOT))
    assert [(member.place, member.ports) for member in members] == [(PLACE, 40), (DOMAIN, 40)]
    assert not told
    state = observed(labelled_container(labels))
    assert master_hosts(read_labels(state, SETTINGS), state) == ("robot",)


def test_where_nothing_says_it_ros_1_is_assumed_and_told() -> None:
    settings = replace(SETTINGS, master_uri=ROBOT)
    members, told = read(labelled_container(), settings)
    assert [member.place for member in members] == [PLACE]
    assert told == [
        "no label and no variable states the ROS version, so the operator assumes ROS 1. Add the "
        "label rosproxy.ros=1 or rosproxy.ros=2"
    ]
    assert read(labelled_container(env=ROBOT), settings)[1] == []


@pytest.mark.parametrize(
    "variables",
    [
        {"ROS_VERSION": ""},
        {"ROS_DISTRO": ""},
        {"ROS_VERSION": "one"},
        *({name: ""} for name in sorted(ROS2_VARIABLES)),
    ],
)
def test_an_unusable_variable_states_no_version(variables: Mapping[str, str]) -> None:
    members, told = read(
        labelled_container(variables=variables), replace(SETTINGS, master_uri=ROBOT)
    )
    assert [member.place for member in members] == [PLACE]
    assert ["assumes ROS 1" in text for text in told] == [True]


@pytest.mark.parametrize("name", sorted(ROS2_VARIABLES))
def test_a_variable_of_ros_2_alone_says_it(name: str) -> None:
    variables = {name: "localhost"} if name == STATIC_PEERS else {name: "7"}
    assert places(labelled_container(variables=variables))[0].graph.ros == "2"
    assert read(labelled_container(variables=variables))[1] == []
    assert places(labelled_container(variables=variables, env=ROBOT)) == [PLACE]


@pytest.mark.parametrize(
    "labels", [{"rosproxy.domain": "0"}, {"rosproxy.peers": "robot"}], ids=["domain", "peers"]
)
def test_a_label_for_ros_2_alone_says_it(labels: Mapping[str, str]) -> None:
    members, told = read(labelled_container({**ON, **labels}))
    assert [member.place for member in members] == [DOMAIN]
    assert not told


def test_where_nothing_says_it_and_no_master_is_known_both_ways_are_told() -> None:
    assert refusal(labelled_container()) == (
        "no label and no variable states the ROS version. Add the label rosproxy.ros=2 for ROS 2, "
        "or the label rosproxy.master-uri=http://HOST:11311 for ROS 1"
    )


def test_the_domain_is_that_of_the_label_or_the_variable() -> None:
    variables = {"ROS_DISTRO": "jazzy", "ROS_DOMAIN_ID": "7"}
    assert places(labelled_container(ON, variables)) == [Place(Domain(7), HERE)]
    assert places(labelled_container({**ON, "rosproxy.domain": "42"}, variables)) == [
        Place(Domain(42), HERE)
    ]
    assert places(labelled_container(ON, {"ROS_DISTRO": "jazzy", "ROS_DOMAIN_ID": ""})) == [DOMAIN]
    text = refusal(labelled_container({**TWO, "rosproxy.domain": "233"}))
    assert text.startswith("label rosproxy.domain='233' is not a domain from 0 to 232")
    assert "variable ROS_DOMAIN_ID='x'" in refusal(labelled_container(TWO, {"ROS_DOMAIN_ID": "x"}))


def test_peers() -> None:
    (member,), told = read(labelled_container({**TWO, "rosproxy.peers": "Robot, 192.0.2.7:11400"}))
    assert sorted(member.peers) == ["192.0.2.7:11400", "robot"]
    assert not told
    twice = labelled_container({**TWO, "rosproxy.peers": "Robot:11400, robot:11400"})
    assert read(twice)[0][0].peers == {"robot:11400"}
    text = refusal(labelled_container({**TWO, "rosproxy.peers": "no/host"}))
    assert text == (
        "label rosproxy.peers: 'no/host' is not of the form HOST or HOST:PORT, such as robot or "
        "192.0.2.7:11400"
    )
    many = " ".join(f"robot{number}" for number in range(33))
    assert "names more than 32 hosts" in refusal(
        labelled_container({**TWO, "rosproxy.peers": many})
    )


def test_peers_that_are_not_allowed_are_left_out() -> None:
    asked = labelled_container(
        {**TWO, "rosproxy.peers": "robot, victim, arm:11400, base:11400, base"}
    )
    patterns = tuple(map(read_host_pattern, ("robot", "*:11400")))
    settings = replace(SETTINGS, allow_peer=patterns, ros2_peer=("base",))

    (member,), (told,) = read(asked, settings)

    assert member.peers == {"robot", "arm:11400", "base:11400", "base"}
    assert told == (
        "label rosproxy.peers names victim, which the operator does not allow in labels. The proxy "
        "announces no participants there. To allow these peers, start the operator with "
        "--allow-peer victim"
    )


def test_labels_of_the_other_version_are_told() -> None:
    assert read(labelled_container({**TWO, "rosproxy.slave-control": "master"}))[1] == [
        "label rosproxy.slave-control is ignored: the label is for ROS 1, the container is not. "
        "Remove the label, or set rosproxy.ros=1 if the nodes use ROS 1"
    ]
    labels = {**ON, "rosproxy.master-uri": ROBOT, "rosproxy.peers": "robot"}
    told = read(labelled_container(labels, env=ROBOT))[1]
    assert told == [
        "label rosproxy.peers is ignored: the label is for ROS 2, the container is not. Remove the "
        "label, or set rosproxy.ros=2 if the nodes use ROS 2"
    ]


def test_plane_direction_and_rules_are_its_own() -> None:
    labels = {
        **TWO,
        "rosproxy.data-plane": "splice",
        "rosproxy.direction": "both",
        "rosproxy.policy": "deny publish /camera/*",
    }
    (member,), told = read(labelled_container(labels))
    assert member.wishes == {"data_plane": "splice", "direction": "both"}
    assert member.policy == parse_rules("deny publish /camera/*")
    assert not told


def test_what_is_no_ipv4_is_left_out() -> None:
    text = refusal(labelled_container(TWO), replace(SETTINGS, advertise_host="2001:db8::1"))
    assert text == (
        "advertised host 2001:db8::1 is an IPv6 address, but the operator starts proxies for ROS 2 "
        "with IPv4 only. Give an IPv4 address"
    )


APP = Network("n1", "app", subnets=(IPv4Network("172.30.0.0/16"),))


@pytest.mark.parametrize("host", ["robot", "192.0.2.7", "Robot.local"])
def test_a_static_peer_outside_is_told(host: str) -> None:
    variables = {STATIC_PEERS: f"rosproxy;{host}"}
    _, (text,) = read(labelled_container(TWO, variables), networks=(UPLINK, APP))
    assert f"ROS_STATIC_PEERS names '{host.lower()}'" in text
    assert text.endswith(f"Unset the variable, and add the label rosproxy.peers='{host.lower()}'")


@pytest.mark.parametrize("peers", ["", "rosproxy", "172.30.0.9;127.0.0.1", "talker; localhost ;"])
def test_a_static_peer_inside_is_not(peers: str) -> None:
    talker = labelled_container(TWO, {STATIC_PEERS: peers})
    assert read(talker, networks=(UPLINK, APP))[1] == []


def test_on_an_internal_network_it_reaches_outside_through_the_proxy() -> None:
    inner = (UPLINK, Network("n1", "app", internal=True))
    (member,), told = read(labelled_container(TWO), networks=inner)
    assert (member.wishes, told) == ({"direction": "both"}, [])


def test_it_is_exposed_by_default_as_it_is_by_its_variables() -> None:
    settings = replace(SETTINGS, expose_by_default=True)
    bare = replace(container(labels={}), variables={"ROS_DISTRO": "jazzy"})
    assert places(bare, settings) == [DOMAIN]
    assert places(bare) == []


def test_the_advertised_host_is_the_address_for_far_hosts() -> None:
    settings = replace(SETTINGS, advertise_host=None)
    members, told = read(labelled_container(TWO), settings, default_route_address=HERE)
    assert ([member.place for member in members], told) == ([DOMAIN], [])
    members, told = read(labelled_container(TWO), settings)
    assert not members
    assert told[0].startswith(
        "the operator does not know this host's address. Add the label rosproxy.adv"
    )


def test_a_container_that_opts_out_has_no_problem_with_other_labels() -> None:
    settings = replace(SETTINGS, expose_by_default=True)
    labels = {"rosproxy.enable": "false", "rosproxy.ros": "3"}
    assert read(labelled_container(labels), settings) == ([], [])
