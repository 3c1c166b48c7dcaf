"""The administrator's bounds of labels."""

from dataclasses import replace

import pytest

from rosproxy.shared.setting_kinds import SlaveControl
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.option_values import read_host_pattern
from rosproxy_operator.docker.planner.actions import Connect, Create, CreateSandbox
from rosproxy_operator.docker.planner.labels.bounds import allowed_planes, refused_master
from rosproxy_operator.docker.planner.model import Member
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from tests.unit.operator.docker.builders import (
    ENABLED,
    HERE,
    SETTINGS,
    attachment,
    container,
    observed,
    planned,
    read_members,
)


def read(
    settings: PlanSettings = SETTINGS, env: str = "http://rosproxy:11311", **labels: str
) -> tuple[Member | None, list[Problem]]:
    """The member for a container with these labels, and the problems."""
    names = {f"rosproxy.{name.replace('_', '-')}": value for name, value in labels.items()}
    talker = container(labels={**ENABLED, **names}, env=env)
    members, problems = read_members(observed(talker), settings)
    return next(iter(members), None), problems


def asked(settings: PlanSettings = SETTINGS, **labels: str) -> tuple[Member, str]:
    """The member for a container with these labels, and the text of its problem, if any."""
    member, problems = read(settings, **labels)
    assert member is not None
    assert all(problem.subject == "container talker" for problem in problems)
    assert not any(problem.fatal for problem in problems)
    return member, "".join(problem.message for problem in problems)


# masters


def allowing(*patterns: str) -> PlanSettings:
    return replace(SETTINGS, allow_master=tuple(map(read_host_pattern, patterns)))


@pytest.mark.parametrize(
    ("pattern", "uri", "allowed"),
    [
        ("robot", "http://robot:11311", True),
        ("robot", "http://robot:80", True),
        ("Robot", "http://robot:11311", True),
        ("robot", "http://robots:11311", False),
        ("robot", "http://a.robot:11311", False),
        ("robot:11311", "http://robot:11311", True),
        ("http://robot:11311/", "http://robot:11311", True),
        ("robot:11311", "http://robot:11312", False),
        ("robot:113*", "http://robot:11312", True),
        ("*:11311", "http://api.example.com:11311", True),
        ("*:11311", "http://api.example.com:443", False),
        ("*.lab.example", "http://robot.lab.example:11311", True),
        ("*.lab.example", "http://lab.example:11311", False),
        ("*.lab.example", "http://robot.lab.example.evil.com:11311", False),
        ("arm?", "http://arm1:11311", True),
        ("192.0.2.*", "http://192.0.2.7:11311", True),
        ("[2001:db8::*]:11311", "http://[2001:db8::9]:11311", True),
        ("[2001:db8::9]", "http://[2001:db8::8]:11311", False),
        ("*", "http://whatever:1", True),
    ],
)
def test_a_pattern(pattern: str, uri: str, allowed: bool) -> None:
    assert (refused_master(uri, allowing(pattern)) is None) == allowed
    assert refused_master(uri, allowing("nobody", pattern)) is None or not allowed


@pytest.mark.parametrize("text", ["", "a b", "robot:", "robot:x", "https://robot", "a/b", "[robot]",
                                  "robot:123456", "rob[o]t"])  # fmt: skip
def test_what_is_no_pattern(text: str) -> None:
    with pytest.raises(ValueError, match="is not of the form HOST or HOST:PORT"):
        read_host_pattern(text)


def test_a_master_that_is_not_allowed() -> None:
    for given in ({"master_uri": "http://api.example.com:8080"}, {"env": "api"}):
        env = "http://api.example.com:8080" if "env" in given else ""
        labels = {} if env else given
        names = {f"rosproxy.{name.replace('_', '-')}": value for name, value in labels.items()}
        talker = container(labels={"rosproxy.enable": "true", **names}, env=env)
        members, (problem,) = read_members(observed(talker), allowing("robot", "arm*:11311"))
        assert members == ()
        assert (problem.subject, problem.fatal) == ("container talker", True)
        source = "variable ROS_MASTER_URI" if env else "label rosproxy.master-uri"
        assert problem.message == (
            f"{source}='http://api.example.com:8080' matches no --allow-master of the operator "
            "(robot:*, arm*:11311). To allow this master, start the operator with --allow-master "
            "api.example.com:8080"
        )


def test_the_operators_own_master_needs_no_pattern() -> None:
    settings = replace(allowing("arm"), master_uri="http://Robot:11311")
    assert read(settings)[0] is not None
    assert read(settings, master_uri="http://robot:11312")[0] is None


@pytest.mark.parametrize("uri", ["http://api.example.com:443", "http://db:1023", "http://x:80"])
def test_by_default_no_master_is_below_port_1024(uri: str) -> None:
    """There a proxy would stand in the place of a web or mail server."""
    member, problems = read(master_uri=uri)
    assert member is None
    (problem,) = problems
    assert "has a port below 1024, which is not allowed for a master by default" in problem.message
    assert f"--allow-master {uri.removeprefix('http://')}" in problem.message
    assert read(allowing(uri), master_uri=uri)[0] is not None


def test_nothing_is_made_and_no_name_taken_for_a_master_that_is_not_allowed() -> None:
    talker = container(labels={**ENABLED, "rosproxy.master-uri": "http://api.example.com:443"})
    plan = planned(observed(talker), SETTINGS, DockerMemory(), 0.0)
    assert plan.actions == ()
    assert plan.members == ()


def test_a_label_takes_no_name_that_a_neighbour_answers_to() -> None:
    """Neither its name nor an alias, such as the name of a Compose service."""
    labels = {**ENABLED, "rosproxy.master-uri": "http://db:5432"}
    for neighbour in (
        container("db", {}),
        container("x-db-1", {}, [attachment("app", "x-db-1", "DB")]),
    ):
        seen = observed(container(labels=labels), neighbour)
        plan = planned(seen, SETTINGS, DockerMemory(), 0.0)
        (joined,) = [action for action in plan.actions if isinstance(action, Connect)]
        assert "db" not in joined.aliases


# ports


@pytest.mark.parametrize(
    ("option", "label", "gets"), [(100, 101, 100), (8, 33, 32), (40, 1000, 40)]
)
def test_more_ports_than_labels_may_ask_for(option: int, label: int, gets: int) -> None:
    """A proxy gets at least the number of --ports."""
    member, told = asked(replace(SETTINGS, max_ports=option), ports=str(label))
    assert member.ports == gets
    assert told == (
        f"label rosproxy.ports={label} exceeds the bound of labels: the proxy gets {gets} ports. "
        f"To allow more, start the operator with --max-ports {label}"
    )
    seen = observed(container(labels={**ENABLED, "rosproxy.ports": str(label)}))
    plan = planned(seen, replace(SETTINGS, max_ports=option), DockerMemory(), 0.0)
    (box,) = [action for action in plan.actions if isinstance(action, CreateSandbox)]
    assert len(box.range) == max(gets, SETTINGS.ports)


def test_as_many_as_they_may() -> None:
    for settings, label in (
        (SETTINGS, 100),
        (replace(SETTINGS, max_ports=1000), 1000),
        (replace(SETTINGS, ports=500), 400),
    ):
        member, told = asked(settings, ports=str(label))
        assert (member.ports, told) == (label, "")


# data planes


def test_which_data_planes_labels_may_ask_for() -> None:
    assert allowed_planes(SETTINGS) == {"auto", "splice", "copy"}
    assert allowed_planes(replace(SETTINGS, data_plane="kernel")) == {
        *("auto", "kernel", "splice", "copy")
    }
    named = replace(SETTINGS, allow_data_plane=("kernel",), data_plane="copy")
    assert allowed_planes(named) == {"kernel", "copy"}


def test_a_data_plane_that_is_not_allowed() -> None:
    member, told = asked(data_plane="kernel")
    assert member.wishes == {}
    assert told == (
        "label rosproxy.data-plane=kernel is ignored: the operator does not allow this value in "
        "labels. To allow this value, start the operator with --allow-data-plane kernel "
        "--allow-data-plane auto --allow-data-plane copy --allow-data-plane splice"
    )
    assert asked(replace(SETTINGS, allow_data_plane=("kernel",)), data_plane="kernel")[1] == ""


# slave control


@pytest.mark.parametrize(
    ("option", "label", "gets", "told"),
    [
        ("any", None, "any", False),
        ("any", "any", "any", False),
        ("any", " Master", "master", False),
        ("master", None, "master", False),
        ("master", "master", "master", False),
        ("master", "any", "master", True),
    ],
)
def test_slave_control(option: SlaveControl, label: str | None, gets: str, told: bool) -> None:
    settings = replace(SETTINGS, slave_control=option)
    labels = {"slave_control": label} if label else {}
    text = asked(settings, **labels)[1]
    assert ("--slave-control master, and a label can only narrow this option" in text) == told
    names = {"rosproxy.slave-control": label} if label else {}
    others = container("other")
    seen = observed(container(labels={**ENABLED, **names}), others)
    plan = planned(seen, settings, DockerMemory(), 0.0)
    (made,) = [action for action in plan.actions if isinstance(action, Create)]
    assert made.spec.slave_control == gets


def test_a_slave_control_that_can_not_be() -> None:
    member, (problem,) = read(slave_control="none")
    assert member is None
    assert problem.message.startswith("label rosproxy.slave-control='none' is none of any, master.")


def test_an_exited_container_keeps_slave_control_narrow_for_the_grace() -> None:
    """Otherwise a container's restart would recreate the proxy twice."""
    narrow = {**ENABLED, "rosproxy.slave-control": "master"}
    seen = observed(container("a"), container("b", narrow, state="exited"))
    first = planned(seen, SETTINGS, DockerMemory(), 0.0)
    assert first.desired[0].spec.slave_control == "master"
    assert first.again_in is not None
    later = planned(seen, SETTINGS, first.memory, 60.0)
    assert later.desired[0].spec.slave_control == "any"
    assert later.desired[0].place.advertise_host == HERE
