"""The labels of containers, and the problems of wrong labels."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.labels.members import master_hosts, read_labels
from rosproxy_operator.docker.planner.model import Container, Member
from rosproxy_operator.docker.planner.specs import proxy_name
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import Master, Place
from tests.unit.operator.docker.builders import (
    ENABLED,
    HERE,
    PLACE,
    ROBOT,
    SETTINGS,
    attachment,
    both,
    container,
    observed,
    proxy,
    read_members,
    sandbox,
)

ON = {"rosproxy.enable": "true"}
EXPOSING = replace(SETTINGS, expose_by_default=True)


def read(
    container: Container, settings: PlanSettings = SETTINGS, *others: Container, **more
) -> tuple[Member | None, list[Problem]]:
    """The member for a container, if any, and the problems."""
    members, problems = read_members(observed(container, *others, **more), settings)
    mine = [problem for problem in problems if problem.subject == f"container {container.name}"]
    return next((member for member in members if member.container == container), None), mine


def refusal(container: Container, settings: PlanSettings = SETTINGS, **more) -> str:
    """Why a container is left out."""
    member, problems = read(container, settings, **more)
    assert member is None
    assert problems[-1].fatal
    return problems[-1].message


def warning(container: Container) -> str:
    """The problem of a container that gets a member nevertheless."""
    member, problems = read(container)
    assert member is not None
    assert [problem.fatal for problem in problems] == [False]
    return problems[0].message


def good(
    container: Container, settings: PlanSettings = SETTINGS, *others: Container, **more
) -> Member:
    """The member of a container with which nothing is wrong."""
    member, problems = read(container, settings, *others, **more)
    assert member is not None
    assert problems == []
    return member


def test_a_labelled_container_wishes_for_a_proxy() -> None:
    labels = {**ENABLED, "rosproxy.ports": "40", "rosproxy.advertise-host": "Host.lab"}
    talker = container(labels=labels, networks=("app", "lab"))
    assert good(talker) == Member(
        talker, Place(Master(ROBOT), "host.lab"), 40, frozenset({"app", "lab"}), "rosproxy"
    )


@pytest.mark.parametrize("value", ["debug", " DEBUG "])
def test_a_label_asks_for_a_log_level(value: str) -> None:
    member = good(container(labels={**ENABLED, "rosproxy.log-level": value}))
    assert member.wishes == {"log_level": "debug"}


@pytest.mark.parametrize("value", ["true", "True", " TRUE "])
def test_the_label_alone_is_enough(value: str) -> None:
    member = good(container(labels={"rosproxy.enable": value}, env=ROBOT))
    assert (member.place, member.ports, member.wanted_alias) == (PLACE, 0, "robot")


URI = "is not of the form http://HOST:11311"
HOST = (
    "is neither a host name nor an address. Give the name or address at which outside reaches this "
    "host"
)
BAD = {
    "rosproxy.enable": ("is neither true nor false. Write rosproxy.enable=true", [
        "yes", "1", "", "ture",
    ]),
    "rosproxy.ports": (
        "is not a number from 1 to 1000. Give the number of ports of the whole proxy, one for each "
        "node, such as rosproxy.ports=32", [
        "0", "1001", "-1", "many", "", "1.5", "٣", "9" * 5000,
    ]),
    "rosproxy.master-uri": (URI, [
        "robot", "robot:11311", "https://robot:11311", "http://robot", "http://robot:0",
        "http://:1", "http://robot:11311/a b", "http://rö:11311", "", "http://u@robot:11311",
    ]),
    "rosproxy.advertise-host": (HOST, ["", "a b", "http://host", "host:1", "-x", "x" * 300]),
    "rosproxy.data-plane": (
        "is none of auto, kernel, splice, copy. Write rosproxy.data-plane=kernel to let the "
        "kernel forward topics, or remove the label", ["", "fast", "kernel,splice", "true"],
    ),
    "rosproxy.log-level": (
        "is none of debug, info, warning, error. Write rosproxy.log-level=debug to see all "
        "messages of the proxy, or remove the label", ["", "warn", "10"],
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("label", "value", "told"),
    [(label, value, told) for label, (told, values) in BAD.items() for value in values],
)
def test_a_value_that_can_not_be(label: str, value: str, told: str) -> None:
    text = refusal(container(labels={**ENABLED, label: value}))
    shown = repr(value) if len(value) <= 80 else repr(f"{value[:79]}…")
    assert text == f"label {label}={shown} {told}"


def test_nobody_else_is_asked() -> None:
    assert read(container(labels={}, env=ROBOT)) == (None, [])
    assert read(container(labels={"com.example": "x"}, env=ROBOT)) == (None, [])


def test_false_is_said_once_and_nothing_is_answered() -> None:
    labels = {**ENABLED, "rosproxy.enable": "false", "rosproxy.prots": "many"}
    for settings in (SETTINGS, EXPOSING):
        assert read(container(labels=labels, env=ROBOT), settings) == (None, [])


def test_a_label_without_enable_is_ignored_and_told() -> None:
    member, problems = read(container(labels={"rosproxy.ports": "8"}, env=ROBOT))
    assert member is None
    assert [problem.fatal for problem in problems] == [False]
    assert problems[0].message == (
        "label rosproxy.ports ignored, since the label rosproxy.enable=true is missing. Add that "
        "label"
    )


@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("rosproxy.enabled", "rosproxy.enable"),
        ("rosproxy.master_uri", "rosproxy.master-uri"),
        ("rosproxy.port", "rosproxy.ports"),
        ("rosproxy.advertise", "rosproxy.advertise-host"),
        ("rosproxy.networks", "rosproxy.network"),
        ("Rosproxy.Ports", "rosproxy.ports"),
        ("rosproxy_ports", "rosproxy.ports"),
        ("rosproxy.dataplane", "rosproxy.data-plane"),
        ("rosproxy.loglevel", "rosproxy.log-level"),
    ],
)
def test_an_unknown_label_and_the_nearest_right_one(name: str, near: str) -> None:
    text = warning(container(labels={**ENABLED, name: "1"}))
    assert text == (
        f"label {name} is unknown and ignored. Did you mean {near}? Create the container again, "
        "with the right label"
    )


def test_an_unknown_label_that_is_near_to_none() -> None:
    text = warning(container(labels={**ENABLED, "rosproxy.colour-scheme": "1"}))
    assert "Known: rosproxy.enable, rosproxy.master-uri, rosproxy.ports," in text


@pytest.mark.parametrize("name", ["rosproxy-test", "rosproxy-version", "rosproxy", "com.rosproxy"])
def test_other_peoples_labels_are_not_ours(name: str) -> None:
    assert read(container(labels={**ENABLED, name: "1"}))[1] == []
    assert read(container(labels={name: "1"})) == (None, [])


@pytest.mark.parametrize("value", ["1", "100", " 32 "])
def test_good_numbers_of_ports(value: str) -> None:
    assert good(container(labels={**ENABLED, "rosproxy.ports": value})).ports == int(value)


# masters


@pytest.mark.parametrize(
    ("uri", "same"),
    [
        ("http://robot:11311", ROBOT),
        ("http://robot:11311/", ROBOT),
        (" http://Robot:11311 ", ROBOT),
        ("http://robot:11311/bridge/", "http://robot:11311/bridge"),
        ("http://192.0.2.7:11312", "http://192.0.2.7:11312"),
        ("http://[2001:DB8::1]:11311", "http://[2001:db8::1]:11311"),
        ("http://host.docker.internal:11311", "http://host.docker.internal:11311"),
    ],
)
def test_a_master_has_one_uri(uri: str, same: str) -> None:
    talker = container(labels={**ON, "rosproxy.master-uri": uri}, env=uri)
    member, _ = read(talker)
    assert member is not None
    assert member.place.master.uri == same


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "[::1]", "0.0.0.0", "a.localhost"])
def test_a_master_on_loopback_is_nobodys(host: str) -> None:
    for labels, env in (
        ({**ON, "rosproxy.master-uri": f"http://{host}:11311"}, ""),
        (ON, f"http://{host}:11311"),
    ):
        text = refusal(container(labels=labels, env=env))
        assert "means the container itself" in text
        assert "set ROS_MASTER_URI=http://rosproxy:11311" in text


@pytest.mark.parametrize(
    "host", ["rosproxy", "rosproxy-robot-0a1b2c", "rosproxy-robot-0a1b2c-ports"]
)
def test_a_proxy_is_no_master(host: str) -> None:
    labels = {**ON, "rosproxy.master-uri": f"http://{host}:11311"}
    assert "names a proxy. Give the real master" in refusal(container(labels=labels))


def test_the_operators_master_is_for_those_who_name_the_proxy_or_nobody() -> None:
    settings = replace(SETTINGS, master_uri="http://arm:11311")
    arm = Place(Master("http://arm:11311"), HERE)
    for env in ("http://rosproxy:11311", f"http://{proxy_name(arm)}:11311"):
        assert good(container(labels=ON, env=env), settings).place == arm
    member, told = read(container(labels=ON, env=""), settings)
    assert member is not None
    assert member.place == arm
    assert "so the operator assumes ROS 1" in told[0].message
    member, _ = read(container(labels=ON, env="http://rosproxy-zoo-0a1b2c:11311"), settings)
    assert member is not None
    assert good(container(labels=ON, env=ROBOT), settings).place == PLACE


def test_no_master() -> None:
    text = refusal(container(labels=ON))
    assert text.startswith("the ROS master is not known. Add the label rosproxy.master-uri=")
    text = refusal(container(labels=ON), replace(SETTINGS, master_uri="robot"))
    assert text == f"the operator's --master-uri 'robot' {URI}"


# by which name the proxy is found


ASTRAY = {
    "http://rosproxy:11312": "has the wrong port, the proxy listens on 11311. Set ROS_MASTER_URI=",
    "http://robot:11312": "has the wrong port, the proxy listens on 11311. Set ROS_MASTER_URI=",
    "http://other:11311": "is not the container's master http://robot:11311, so the nodes ",
    "http://localhost:11311": "means the container itself. Set ROS_MASTER_URI=",
    "http://rosproxy-arm-0a1b2c:11311": "names the proxy of another master, not rosproxy-robot-",
    "robot:11311": f"{URI}. Set ROS_MASTER_URI=",
    "http://192.0.2.7:11399": "is an address, so the nodes bypass the proxy, and outside can't",
}


@pytest.mark.parametrize(("env", "told"), ASTRAY.items())
def test_a_variable_that_leads_astray(env: str, told: str) -> None:
    text = warning(container(env=env))
    assert text.startswith(f"variable ROS_MASTER_URI={env!r}")
    assert told in text
    assert "Set ROS_MASTER_URI=http://rosproxy:11311" in text


@pytest.mark.parametrize("env", ["http://rosproxy:11311", "http://ROBOT:11311/", ROBOT])
def test_a_variable_that_leads_to_the_proxy(env: str) -> None:
    needs = "rosproxy" if "rosproxy" in env else "robot"
    assert good(container(env=env)).wanted_alias == needs


def test_an_address_is_told_the_variable_and_the_label_at_once() -> None:
    """If the user sets only one, the other names no master, or names the proxy as the master."""
    uri = "http://192.0.2.7:11311"
    settings = replace(SETTINGS, redirect=False)
    _, (problem,) = read(container(labels=ON, env=uri), settings)
    advice = f"Set ROS_MASTER_URI=http://rosproxy:11311 and the label rosproxy.master-uri={uri}, or"
    assert advice in problem.message
    cured = container(labels={**ON, "rosproxy.master-uri": uri}, env="http://rosproxy:11311")
    assert good(cured, settings).place.master.uri == uri


def test_no_variable_leads_to_localhost() -> None:
    """Nodes with a variable of their own still find the proxy."""
    assert warning(container(env="")) == (
        "has no variable ROS_MASTER_URI, so the nodes look for a master on localhost, unless a "
        "script sets the variable. Set ROS_MASTER_URI=http://rosproxy:11311"
    )
    member, _ = read(container(env=""))
    assert member is not None
    assert member.wanted_alias == "rosproxy"


# this host's address


def test_who_says_what_this_host_is_called() -> None:
    labelled = container(labels={**ENABLED, "rosproxy.advertise-host": "[2001:db8::5]"})
    addresses = {"robot": "192.0.2.99"}
    for talker, settings, host in (
        (labelled, SETTINGS, "2001:db8::5"),
        (container(), SETTINGS, HERE),
        (container(), PlanSettings(), "192.0.2.99"),
    ):
        assert good(talker, settings, advertise=addresses).place.advertise_host == host


def test_loopback_is_no_address_for_others() -> None:
    labels = {**ENABLED, "rosproxy.advertise-host": "127.0.0.1"}
    assert "is loopback, which no other host can reach" in refusal(container(labels=labels))


def test_an_address_that_is_not_known() -> None:
    text = refusal(container(), PlanSettings())
    assert text.startswith("the operator does not know this host's address towards the master ")
    assert "--advertise-host" in text


def test_a_masters_name_that_leads_nowhere_is_the_cause_and_its_fix_the_whole() -> None:
    text = refusal(container(), PlanSettings(), masters={"robot": ""})
    assert text.startswith("no address of the master: the operator can't resolve the host name")
    assert "--add-host robot:ADDRESS" in text
    assert "advertise-host" not in text


@pytest.mark.parametrize(
    ("label", "meant"),
    [
        ("ros-proxy.enable", "rosproxy.enable"),
        ("ros_proxy.ports", "rosproxy.ports"),
        ("rosproxi.enable", "rosproxy.enable"),
        ("ros.proxy.master-uri", "rosproxy.master-uri"),
        ("ROSPROXY.ENABEL", "rosproxy.enable"),
    ],
)
def test_a_misspelt_label_is_told_with_the_one_that_was_meant(label: str, meant: str) -> None:
    member, (told, *_) = read(container(labels={label: "true"}))
    assert member is None
    assert f"label {label} is unknown and ignored. Did you mean {meant}?" in told.message


@pytest.mark.parametrize(
    "label", ["traefik.enable", "haproxy.enable", "com.docker.compose.project", "rosbridge.enable"]
)
def test_labels_of_others_are_left_alone(label: str) -> None:
    assert read(container(labels={label: "true"})) == (None, [])


def test_an_address_that_is_not_known_for_a_moment() -> None:
    """An existing proxy stays, if possible the proxy on the container's network."""
    other = Place(Master(ROBOT), "192.0.2.1")
    seen = [sandbox(other, networks=()), sandbox(PLACE)]
    assert good(container(), PlanSettings(), sandboxes=seen).place == PLACE


# networks


@pytest.mark.parametrize(
    ("networks", "labels", "joined"),
    [
        (("bridge", "app", "0-rosproxy"), {}, "app"),
        (("app", "lab"), {"rosproxy.network": "lab"}, "lab"),
        (
            ("demo_lab", "demo_default"),
            {"rosproxy.network": "lab", "com.docker.compose.project": "demo"},
            "demo_lab",
        ),
    ],
)
def test_one_network_of_several(
    networks: tuple[str, ...], labels: dict[str, str], joined: str
) -> None:
    assert good(container(labels={**ENABLED, **labels}, networks=networks)).networks == {joined}


def test_a_network_that_it_is_not_on() -> None:
    talker = container(labels={**ENABLED, "rosproxy.network": "app2"}, networks=("lab", "app"))
    assert refusal(talker) == (
        "label rosproxy.network='app2' is no network of the container. The container's networks: "
        "app, lab"
    )


@pytest.mark.parametrize(
    ("networks", "mode", "told"),
    [
        (("bridge",), "bridge", "is only on the default bridge network, which the proxy does not"),
        ((), "default", "is only on the default bridge network"),
        (("host",), "host", "is on the host's own network, where nodes need no proxy"),
        (("none",), "none", "is on no network"),
        ((), "app", "is on no network"),
    ],
)
def test_networks_where_no_proxy_is_found(networks: tuple[str, ...], mode: str, told: str) -> None:
    text = refusal(container(networks=networks, mode=mode))
    assert text.startswith(told)
    assert "docker network create ros" in text
    joins_live = mode not in ("host", "none")
    assert ("docker network connect ros talker" in text) is joins_live
    assert ("docker run --network ros" in text) is not joins_live


def test_the_network_of_another_container() -> None:
    pod = container("pod", {}, ("app", "lab"))
    talker = container("talker", networks=(), mode="container:id-pod")
    two = container("two", networks=(), mode="container:id-talker")
    for guest, other in ((talker, two), (two, talker)):
        assert good(guest, SETTINGS, pod, other).networks == {"app", "lab"}


def test_the_network_of_a_container_that_is_gone() -> None:
    talker = container(networks=(), mode="container:id-pod")
    assert "shares the network of container 'id-pod', which does not exist" in refusal(talker)


def test_containers_that_share_the_network_of_each_other() -> None:
    talker = container("talker", networks=(), mode="container:id-two")
    two = container("two", networks=(), mode="container:id-talker")
    for guest, others in (
        (talker, (two,)),
        (replace(talker, network_mode="container:id-talker"), ()),
    ):
        _, (problem,) = read(guest, SETTINGS, *others)
        text = problem.message
        assert "which shares the network of this container. Create one of the two" in text
        assert "does not exist" not in text


# states


@pytest.mark.parametrize("state", ["created", "running", "paused", "restarting"])
def test_who_lives_counts(state: str) -> None:
    assert good(container(state=state)).container.alive


def test_who_has_exited_has_no_problems() -> None:
    gone = container(labels={**ENABLED, "rosproxy.what": "1"}, state="exited")
    assert not good(gone).container.alive
    assert read(container(labels=ON, state="exited")) == (None, [])


@pytest.mark.parametrize("state", ["dead", "removing", "whatever"])
def test_who_is_dead_wants_nothing(state: str) -> None:
    assert read(container(state=state)) == (None, [])


# --expose-by-default


def test_everybody_with_a_master_is_exposed() -> None:
    assert good(container(labels={}, env=ROBOT), EXPOSING).place == PLACE
    assert good(container(labels={"rosproxy.master-uri": ROBOT}), EXPOSING).place == PLACE
    assert read(container(labels={}, env=""), EXPOSING) == (None, [])


def test_who_has_not_asked_is_no_failure() -> None:
    talker = container(labels={}, env=ROBOT, networks=("host",))
    member, problems = read(talker, EXPOSING)
    assert member is None
    assert [problem.fatal for problem in problems] == [False]


# all together


def test_one_bad_container_does_not_touch_the_others() -> None:
    good = [container("a"), container("b", state="exited"), container("c", ON, env=ROBOT)]
    bad = [
        container("bad1", {**ENABLED, "rosproxy.ports": "0"}),
        container("bad2", ON),
        container("bad3", networks=()),
    ]
    members, _ = read_members(observed(*good), SETTINGS)
    with_bad, problems = read_members(observed(*bad, *good), SETTINGS)
    assert with_bad == members
    fatal = {problem.subject for problem in problems if problem.fatal}
    assert fatal == {"container bad1", "container bad2", "container bad3"}


def test_a_container_with_the_operators_own_label() -> None:
    _, problems = read(container(labels={"io.rosproxy.managed": "true"}))
    assert problems[0].message.startswith(
        "has the label io.rosproxy.managed, but not the other labels"
    )


def test_whose_address_is_needed() -> None:
    proxy_place = Place(Master("http://left:11311"), HERE)
    seen = observed(
        container("a"),
        container("b", ON, env="http://arm:11311"),
        container("c", ON, env="http://gone:11311", state="exited"),
        container("d", ON),
        container("e", {**ON, "rosproxy.enable": "maybe"}, env="http://no:11311"),
        **both(place=proxy_place),
    )
    assert master_hosts(read_labels(seen, SETTINGS), seen) == ("arm", "left", "robot")


def test_a_proxy_of_whatever_name_is_no_master() -> None:
    odd = {"sandboxes": [sandbox(name="odd")], "proxies": [proxy(name="strange")]}
    for host in ("odd", "strange"):
        talker = container(labels=ON, env=f"http://{host}:11311")
        member, _ = read(talker, replace(SETTINGS, master_uri=ROBOT), **odd)
        assert member is not None
        assert member.place == PLACE


TEXT = st.text(max_size=30) | st.sampled_from(["true", ROBOT, "app", "8", HERE])
LABELS = st.dictionaries(
    st.sampled_from(
        ["rosproxy.enable", "rosproxy.master-uri", "rosproxy.ports", "rosproxy.advertise-host",
         "rosproxy.network", "rosproxy.x", "rosproxy", "com.docker.compose.project"]
    ),
    TEXT,
)  # fmt: skip


@given(LABELS, TEXT, TEXT, st.booleans())
def test_labels_of_whatever_kind_are_read_or_told(
    labels: dict[str, str], env: str, mode: str, expose: bool
) -> None:
    odd = container("odd", labels, [attachment("app")], env=env, mode=mode)
    settings = replace(SETTINGS, expose_by_default=expose)
    member, problems = read(odd, settings)
    asked = labels.get("rosproxy.enable", "").strip().lower()
    if asked == "true":
        assert member or any(problem.fatal for problem in problems)
    if member:
        assert member.place.master.uri.startswith("http://")
        assert member.place.advertise_host
        assert 0 <= member.ports <= 1000
