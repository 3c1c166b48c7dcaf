"""Names that a label gives a proxy: names of hosts on the LAN, never names of containers."""

from dataclasses import replace
from typing import Any

import pytest

from rosproxy_operator.docker.option_values import read_name_pattern
from rosproxy_operator.docker.planner.actions import Connect, Disconnect
from rosproxy_operator.docker.planner.labels.alias_bounds import alias_refusal
from rosproxy_operator.docker.planner.model import Container, Network
from rosproxy_operator.docker.planner.plan import DockerPlan
from rosproxy_operator.docker.planner.specs import proxy_name
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.planner.taken_names import MOST_REMEMBERED_NAMES, remember_names
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import Master, Place
from tests.unit.operator.docker.builders import (
    APP,
    HERE,
    SETTINGS,
    UPLINK,
    attachment,
    both,
    container,
    observed,
    planned,
    sandbox,
)

DB = Place(Master("http://db:5432"), HERE)
BACK = Network("n3", "back")
LAN = Network("n4", "lan")
NETWORKS = (UPLINK, APP, BACK, LAN)


def allowing(*patterns: str, **more: Any) -> PlanSettings:
    return replace(SETTINGS, allow_alias=tuple(map(read_name_pattern, patterns)), **more)


def hostile(uri: str = DB.master.uri, env: str = "http://rosproxy:5432", **more: Any) -> Container:
    """A container whose image has a label with the name of a service."""
    labels = {"rosproxy.enable": "true", "rosproxy.master-uri": uri}
    return container("hostile", labels, env=env, **more)


def look(
    *containers: Container,
    settings: PlanSettings = SETTINGS,
    memory: DockerMemory | None = None,
    **more: Any,
) -> DockerPlan:
    seen = observed(*containers, networks=NETWORKS, **more)
    return planned(seen, settings, memory or DockerMemory(), 0.0)


def aliases(plan: DockerPlan, network: str = "app") -> set[str]:
    """The names under which a proxy joins a network."""
    (joined,) = [a for a in plan.actions if isinstance(a, Connect) and a.network == network]
    return set(joined.aliases)


def told(plan: DockerPlan) -> list[str]:
    return [problem.message for problem in plan.problems]


# the form of a name


@pytest.mark.parametrize(
    "name",
    ["robot", "robot-1", "arm_2", "robot.local", "robot.lan", "a.robot.lan", "robot.home",
     "robot.localdomain", "robot.home.arpa", "robot.test", "db"],
)  # fmt: skip
def test_names_of_a_lan_need_no_option(name: str) -> None:
    assert alias_refusal(name, SETTINGS) == ""


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("kubernetes.default.svc", "has a dot, and is not in"),
        ("kubernetes.default.svc.cluster.local", "belong to services of a Kubernetes cluster"),
        ("db.cluster.local", "belong to services of a Kubernetes cluster"),
        ("cluster.local", "belong to services of a Kubernetes cluster"),
        ("pypi.org", "has a dot, and is not in"),
        ("robot.example.com", "has a dot, and is not in"),
        ("gitlab.corp", "has a dot, and is not in"),
        ("notlan", ""),
        ("robot.notlan", "has a dot, and is not in"),
        ("host.docker.internal", "has a dot, and is not in"),
        ("gateway.docker.internal", "has a dot, and is not in"),
        ("metadata.google.internal", "has a dot, and is not in"),
        ("home.arpa.evil.com", "has a dot, and is not in"),
        ("rosproxy-operator", "reserved for the operator"),
        ("rosproxy-robot-1f3a9c-ports.lan", "reserved for the operator"),
        ("pypi.org.", "not a host name"),
        ("db.", "not a host name"),
        (".db", "not a host name"),
        ("a..lan", "not a host name"),
        ("-db", "not a host name"),
        ("db-", "not a host name"),
        ("d" * 64, "not a host name"),
        (".".join(["d" * 63] * 4), "not a host name"),
    ],
)
def test_names_of_services_need_an_option(name: str, why: str) -> None:
    refusal = alias_refusal(name, SETTINGS)
    assert why in refusal
    assert bool(refusal) == bool(why)


def test_the_administrator_says_which_names_there_are() -> None:
    settings = allowing("*.Lab.example", "arm?")
    assert alias_refusal("robot.lab.example", settings) == ""
    assert alias_refusal("arm1", settings) == ""
    for name in ("robot", "robot.lan", "lab.example", "robot.lab.example.evil.com"):
        assert alias_refusal(name, settings) == (
            "the name matches no --allow-alias of the operator (*.lab.example, arm?)"
        )
    own = allowing("arm", master_uri="http://Robot.example.com:11311")
    assert alias_refusal("robot.example.com", own) == ""


@pytest.mark.parametrize("text", ["", "a b", "http://robot", "robot:11311", "[::1]", "a/b"])
def test_what_is_no_pattern_of_a_name(text: str) -> None:
    with pytest.raises(ValueError, match="is not a host name such as"):
        read_name_pattern(text)


# what a refusal costs


def test_a_refused_name_costs_that_name_alone() -> None:
    uri = "http://robot.example.com:11311"
    place = Place(Master(uri), HERE)
    plan = look(container("talker", {"rosproxy.enable": "true"}, env=uri))
    assert aliases(plan) == {"rosproxy", proxy_name(place)}
    (text,) = told(plan)
    assert text == (
        "the nodes look for the proxy by the name robot.example.com, but labels may not give a "
        "proxy that name on network app: the name has a dot, and is not in .local, .lan, .home, "
        ".localdomain, .home.arpa, .test. So the nodes bypass the proxy. Start the operator with "
        "--allow-alias robot.example.com (and with this option for every other name that a proxy "
        f"may have), or set ROS_MASTER_URI=http://rosproxy:11311 and the label "
        f"rosproxy.master-uri={uri}"
    )
    assert not any(problem.fatal for problem in plan.problems)
    allowed = look(
        container("talker", {"rosproxy.enable": "true"}, env=uri),
        settings=allowing("robot.example.com"),
    )
    assert aliases(allowed) == {"rosproxy", "robot.example.com", proxy_name(place)}
    assert told(allowed) == []


def test_a_refused_name_that_no_node_uses_is_no_problem() -> None:
    plan = look(hostile("http://pypi.org:11311", "http://rosproxy:11311"))
    assert "pypi.org" not in aliases(plan)
    assert told(plan) == []


def test_a_name_that_is_refused_now_is_taken_back() -> None:
    """An operator with other options, or of a newer version, finds the proxy with the name."""
    place = Place(Master("http://pypi.org:11311"), HERE)
    plan = look(hostile(place.master.uri, "http://rosproxy:11311"), **both(place=place))
    assert aliases(plan) == {"rosproxy", proxy_name(place)}
    after = sandbox(place, networks=[attachment("app", "rosproxy", proxy_name(place))])
    again = look(
        hostile(place.master.uri, "http://rosproxy:11311"),
        **{**both(place=place), "sandboxes": [after]},
    )
    assert again.actions == ()


# names of containers


@pytest.mark.parametrize("state", ["created", "running", "exited"])
def test_a_container_that_comes_later_gets_its_name_from_the_proxy(state: str) -> None:
    """Neighbours must never reach the proxy under that name."""
    steady = look(hostile(), **both(place=DB))
    assert steady.actions == ()
    for newcomer in (
        container("db", {}, state=state),
        container("x-db-1", {}, [attachment("app", "x-db-1", "DB")], state=state),
    ):
        plan = look(hostile(), newcomer, **both(place=DB), memory=steady.memory)
        box = sandbox(DB).container.name
        names = ("rosproxy", proxy_name(DB))
        assert plan.actions == (Disconnect(box, "app"), Connect(box, "app", names))


def test_the_name_of_a_container_that_is_gone_stays_its_own() -> None:
    """``docker compose up`` recreates containers in turn."""
    before = look(container("x-db-1", {}, [attachment("app", "x-db-1", "db")]))
    plan = look(hostile(env=DB.master.uri), memory=before.memory)
    assert "db" not in aliases(plan)
    (text,) = told(plan)
    assert "container x-db-1 had the name, and may return. So the nodes" in text
    assert "--allow-alias db (" in text
    allowed = look(hostile(env=DB.master.uri), memory=before.memory, settings=allowing("db"))
    assert "db" in aliases(allowed)
    elsewhere = look(hostile(networks=("back",)), memory=before.memory)
    assert "db" in aliases(elsewhere, "back")


def test_an_option_takes_no_name_from_a_container_that_is_there() -> None:
    plan = look(hostile(), container("db", {}), settings=allowing("db"))
    assert "db" not in aliases(plan)


def test_a_name_on_another_network_of_a_neighbour_is_taken() -> None:
    """The engine searches a neighbour's networks for a name in any order."""
    web = container("web", {}, ("app", "back"))
    db = container("db", {}, ("back",))
    plan = look(hostile(env=DB.master.uri), web, db)
    assert "db" not in aliases(plan)
    assert "that name belongs to container db (network back)." in told(plan)[0]
    assert "db" in aliases(look(hostile(), db))


def test_a_name_with_the_name_of_a_network_is_that_of_a_container_there() -> None:
    """Engines answer to ``db.lan`` for the container db of the network lan."""
    uri = "http://db.lan:11311"
    db = container("db", {}, ("lan",))
    plan = look(hostile(uri, uri), db)
    assert "db.lan" not in aliases(plan)
    assert "that name belongs to container db." in told(plan)[0]
    gone = look(hostile(uri, uri), memory=plan.memory)
    assert "db.lan" not in aliases(gone)
    assert "db.lan" in aliases(look(hostile(uri, uri)))


def test_no_label_of_an_image_takes_a_name_from_a_proxy() -> None:
    """An image may have Compose's labels. Only aliases count."""
    forged = container("web", {"com.docker.compose.service": "robot"})
    uri = "http://robot:11311"
    plan = look(container("talker", {"rosproxy.enable": "true"}, env=uri), forged)
    assert "robot" in aliases(plan)


def test_a_proxy_that_only_lingers_leaves_a_container_its_name() -> None:
    gone = hostile(state="exited")
    assert look(gone, **both(place=DB)).actions == ()
    plan = look(gone, container("db", {}), **both(place=DB))
    assert plan.actions == (Disconnect(sandbox(DB).container.name, "app"),)


def test_a_proxy_that_can_not_be_made_leaves_a_container_its_name() -> None:
    """Without the image the operator cannot create the proxy, but the sandbox has the name."""
    plan = look(hostile(), container("db", {}), sandboxes=[sandbox(DB)], image="")
    assert plan.actions == (Disconnect(sandbox(DB).container.name, "app"),)


def test_names_are_forgotten_when_there_are_too_many() -> None:
    present = {"app": {"db": frozenset({"db"})}}
    crowd = {"app": {f"c{n}": frozenset({f"c{n}"}) for n in range(MOST_REMEMBERED_NAMES - 1)}}
    former = remember_names({}, present, ())
    former = remember_names(former, crowd, ())
    assert former["app", "db"] == "db"
    assert len(former) == MOST_REMEMBERED_NAMES
    former = remember_names(
        former, {"app": {"c0": frozenset({"c0"}), "new": frozenset({"new"})}}, ()
    )
    assert len(former) == MOST_REMEMBERED_NAMES
    assert ("app", "db") not in former
    assert {("app", "c0"), ("app", "new")} <= former.keys()


def test_short_ids_are_not_remembered() -> None:
    db = replace(
        container("db", {}, [attachment("app", "db", "0123456789ab")]), id="0123456789abcdef"
    )
    assert look(db).memory.names == {("app", "db"): "db"}
