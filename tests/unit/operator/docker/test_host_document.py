"""The status of a host: containers, proxies and problems."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import pytest

from rosproxy.shared.documents.status_document import (
    DomainStatus,
    ParticipantStatus,
    ProxyStatus,
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohSessionStatus,
    ZenohStatus,
)
from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.problem import Problem, with_fix
from rosproxy_operator.docker.host_document import (
    NODES_STARTING_S,
    PROXY_STARTING_S,
    container_names,
    host_document,
)
from rosproxy_operator.docker.planner.model import Attachment
from rosproxy_operator.docker.planner.report import render
from rosproxy_operator.docker.planner.specs import proxy_name
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import ZENOH, Domain, Place
from tests.unit.operator.docker.builders import (
    HERE,
    PLACE,
    SETTINGS,
    container,
    observed,
    planned,
    proxy,
)

TIGHT = PlanSettings(advertise_host=HERE, ports=2, port_window=PortRange(11400, 11401))


def test_a_labelled_container_without_a_proxy_is_listed() -> None:
    """The problem is the small port window, not a missing label."""
    state = observed(container(), listening=[11400])
    made = planned(state, TIGHT, DockerMemory(), 0.0)
    assert not made.actions
    status = host_document(state, made, made.problems, {}, TIGHT, 0.0)
    (row,) = status["containers"]
    assert (row["name"], row["proxy"]) == ("talker", None)
    text = render({**status, "operator": None}, 120)
    assert "No container is labelled" not in text
    assert "--port-window" in text


def test_a_container_whose_master_is_refused_is_listed() -> None:
    settings = replace(SETTINGS, allow_master=("arm:*",))
    state = observed(container())
    made = planned(state, settings, DockerMemory(), 0.0)
    (row,) = host_document(state, made, made.problems, {}, settings, 0.0)["containers"]
    assert (row["name"], row["proxy"]) == ("talker", None)


@pytest.mark.parametrize(("place", "up"), [(PLACE, False), (Place(Domain(0), HERE), None)])
def test_only_a_proxy_for_ros_1_has_a_master(place: Place, up: bool | None) -> None:
    """A proxy for ROS 2 has no master, which is not a fault."""
    running = proxy(PLACE)
    own = replace(running.container, name=proxy_name(place))
    state = observed(proxies=[replace(running, place=place, container=own)])
    made = planned(state, SETTINGS, DockerMemory(), 0.0)
    answers = {proxy_name(place): ProxyStatus()}
    (row,) = host_document(state, made, (), answers, SETTINGS, 0.0)["proxies"]
    assert (row["reachable"], row["master_up"]) == (True, up)


DOMAIN = Place(Domain(0), HERE)
STARTED = 1_700_000_000.0
STARTED_AT = "2023-11-14T22:13:20.123456789Z"
TALKER = Attachment("app", "172.30.0.5")


def told_of_talker(
    variables: Mapping[str, str],
    inside: Sequence[str] = (),
    age: float = NODES_STARTING_S,
    uptime: float = NODES_STARTING_S,
) -> list[str]:
    """The problems of a labelled ROS 2 container in the status of a host.

    ``inside`` are the addresses of the participants that the proxy has heard.
    """
    labels = {"rosproxy.enable": "true", "rosproxy.ros": "2"}
    talker = container(labels=labels, networks=[TALKER], env="")
    talker = replace(talker, variables=variables, started_at=STARTED_AT)
    running = proxy(PLACE)
    own = replace(running.container, name=proxy_name(DOMAIN))
    state = observed(talker, proxies=[replace(running, place=DOMAIN, container=own)])
    made = planned(state, SETTINGS, DockerMemory(), 0.0)
    participants = tuple(ParticipantStatus("01.0f.aa", address) for address in inside)
    status = ProxyStatus(uptime=uptime, domains=(DomainStatus(inside=participants),))
    document = host_document(
        state, made, (), {proxy_name(DOMAIN): status}, SETTINGS, STARTED + age + 1
    )
    return [with_fix(p["text"], p["fix"]) for p in document["problems"]]


@pytest.mark.parametrize(
    ("age", "is_told"),
    [(-3600.0, True), (1.0, False), (PROXY_STARTING_S - 0.1, False), (PROXY_STARTING_S, True)],
)
def test_a_proxy_that_has_just_started_may_be_silent(age: float, is_told: bool) -> None:
    """Even if the engine's clock is ahead, later silence is a problem."""
    running = proxy(PLACE)
    own = replace(running.container, name="p", started_at=STARTED_AT)
    state = observed(proxies=[replace(running, container=own)])
    made = planned(state, SETTINGS, DockerMemory(), 0.0)
    silence = Problem("proxy p", "admin endpoint refuses connections", reason="X")
    document = host_document(state, made, (), {"p": silence}, SETTINGS, STARTED + age)
    told = [with_fix(p["text"], p["fix"]) for p in document["problems"]]
    assert (silence.text in told) is is_told


def test_only_variables_of_the_rmw_in_use_are_named() -> None:
    of_cyclone = {"CYCLONEDDS_URI": "file:///cyclone.xml"}
    of_fast = {"FASTRTPS_DEFAULT_PROFILES_FILE": "/profile.xml"}
    assert not told_of_talker({**of_cyclone, "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"})
    assert not told_of_talker({**of_fast, "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"})
    (text,) = told_of_talker({**of_cyclone, **of_fast})
    assert "Or the cause is FASTRTPS_DEFAULT_PROFILES_FILE" in text


@pytest.mark.parametrize(
    ("variables", "fix"),
    [
        ({"ROS_DISCOVERY_SERVER": "10.0.0.9:11811"}, "Unset the variable"),
        ({"ROS_LOCALHOST_ONLY": "1"}, "Unset the variable"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "localhost"}, "or set SUBNET"),
        ({"FASTDDS_BUILTIN_TRANSPORTS": "SHM"}, "or set UDPv4"),
        ({"FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA?max_msg_size=1MB"}, "or set UDPv4"),
        ({"CYCLONEDDS_URI": "file:///cyclone.xml"}, "or change the profile"),
        ({"FASTRTPS_DEFAULT_PROFILES_FILE": "/profile.xml"}, "or change the profile"),
    ],
)
def test_a_variable_is_named_where_no_participant_is_heard(
    variables: dict[str, str], fix: str
) -> None:
    (text,) = told_of_talker(variables)
    ((name, value),) = variables.items()
    assert f"Possible cause, if a participant runs: variable {name}={value}. " in text
    assert fix in text
    assert not told_of_talker(variables, inside=[TALKER.address]), "all is well"
    assert not told_of_talker(variables, age=1.0), "the container has just started"
    assert not told_of_talker(variables, uptime=1.0), "the proxy has just started"


@pytest.mark.parametrize(
    "variables",
    [
        {},
        {"ROS_DOMAIN_ID": "0", "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"},
        {"ROS_LOCALHOST_ONLY": "0"},
        {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"},
    ],
)
def test_variables_that_keep_no_participant_apart(variables: dict[str, str]) -> None:
    assert not told_of_talker(variables)


def test_a_container_in_the_network_of_another_has_its_participants() -> None:
    """The other container needs no label."""
    pause = container("pause", labels={}, networks=[TALKER])
    labels = {"rosproxy.enable": "true", "rosproxy.ros": "2"}
    talker = container(labels=labels, networks=(), env="", mode=f"container:{pause.id}")
    running = proxy(PLACE)
    own = replace(running.container, name=proxy_name(DOMAIN))
    state = observed(pause, talker, proxies=[replace(running, place=DOMAIN, container=own)])
    made = planned(state, SETTINGS, DockerMemory(), 0.0)
    domain = DomainStatus(inside=(ParticipantStatus("01.0f.aa", TALKER.address),))
    answers = {proxy_name(DOMAIN): ProxyStatus(domains=(domain,))}
    (row,) = host_document(state, made, (), answers, SETTINGS, STARTED)["containers"]
    assert row["name"] == talker.name
    assert [p["guid_prefix"] for p in row["participants"]] == ["01.0f.aa"]


def test_addresses_have_the_names_of_their_running_containers() -> None:
    pause = container("pause", networks=[TALKER])
    talker = container("talker", networks=(), mode=f"container:{pause.id}")
    gone = container("gone", networks=[replace(TALKER, address="172.30.0.9")], state="exited")
    assert container_names(observed(pause, talker, gone)) == {TALKER.address: "pause, talker"}


@pytest.mark.parametrize(
    ("file", "remote", "age", "is_told"),
    [
        ("/my.json5", "172.30.0.9:4000", NODES_STARTING_S, True),
        ("/my.json5", f"{TALKER.address}:4000", NODES_STARTING_S, False),
        ("/my.json5", "172.30.0.9:4000", 1.0, False),
        ("", "172.30.0.9:4000", NODES_STARTING_S, False),
    ],
)
def test_a_file_of_sessions_is_named_where_no_node_has_connected(
    file: str, remote: str, age: float, is_told: bool
) -> None:
    talker = container(labels={"rosproxy.enable": "true"}, networks=[TALKER], env="")
    variables = {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp", "ZENOH_SESSION_CONFIG_URI": file}
    talker = replace(talker, variables=variables, started_at=STARTED_AT)
    state = observed(talker)
    made = planned(state, SETTINGS, DockerMemory(), 0.0)
    sessions = (ZenohSessionStatus(7448, "peer", "1", "172.30.0.2:7448", remote),)
    status = ProxyStatus(uptime=NODES_STARTING_S, zenoh=ZenohStatus(sessions=sessions))
    answers = {proxy_name(ZENOH): status}
    document = host_document(state, made, (), answers, SETTINGS, STARTED + age + 1)
    told = [with_fix(p["text"], p["fix"]) for p in document["problems"]]
    assert any("variable ZENOH_SESSION_CONFIG_URI=/my.json5. " in text for text in told) is is_told


def test_a_container_of_rmw_zenoh_has_its_nodes_and_its_proxy_the_links() -> None:
    zenoh = {"ROS_DISTRO": "kilted", "RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}
    talker = container(labels={"rosproxy.enable": "true"}, networks=[TALKER], env="")
    running = proxy(PLACE)
    own = replace(running.container, name=proxy_name(ZENOH))
    state = observed(
        replace(talker, variables=zenoh), proxies=[replace(running, place=ZENOH, container=own)]
    )
    made = planned(state, SETTINGS, DockerMemory(), 0.0)
    nodes = (ZenohNodeStatus("/talker", 0, TALKER.address), ZenohNodeStatus("/robot", 0, ""))
    routers = ZenohStatus(links=(ZenohLinkStatus("robot:7447", up=True),), nodes=nodes)
    answers = {proxy_name(ZENOH): ProxyStatus(zenoh=routers)}
    document = host_document(state, made, (), answers, SETTINGS, STARTED)
    (row,) = document["proxies"]
    assert (row["ros"], row["links"], row["used"]) == ("zenoh", {"robot:7447": True}, None)
    (row,) = document["containers"]
    assert (row["ros"], [node["name"] for node in row["zenoh_nodes"]]) == ("zenoh", ["/talker"])
    assert row["redirect"] == {"master": "127.0.0.1:7447", "in_place": False}
