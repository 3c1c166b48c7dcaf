"""Conntrack entries for a sandbox's UDP ports are deleted after each start of the sandbox."""

from dataclasses import asdict, replace
from typing import Any

import pytest
from msgspec import structs

from rosproxy.shared.documents.doctor_finding import Severity
from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.doctor import host_findings
from rosproxy_operator.docker.engine_json import check_inspection, read_making
from rosproxy_operator.docker.planner.actions import Action, CreateFlush, Remove, Run
from rosproxy_operator.docker.planner.flush import flush_config
from rosproxy_operator.docker.planner.labels.members import LabelReading
from rosproxy_operator.docker.planner.model import FlushContainer, HostState, Sandbox
from rosproxy_operator.docker.planner.own_containers import forgery_reason
from rosproxy_operator.docker.planner.plan import DockerPlan, Group
from rosproxy_operator.docker.planner.specs import (
    Creation,
    flush_name,
    own_labels,
    proxy_name,
    read_own,
    sandbox_name,
)
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.planner.uninstall import Uninstall
from rosproxy_operator.proxy_spec.place import Domain, Place
from tests.unit.operator.docker.builders import (
    HERE,
    IMAGE,
    RANGE,
    SETTINGS,
    both,
    container,
    inspection,
    observed,
    planned,
)
from tests.unit.operator.docker.test_lan_relay import PLACE, TALKER, running_proxy

NAME = flush_name(PLACE)
SANDBOX_STARTED = "2026-01-01T10:00:00Z"
LATER = "2026-01-01T10:00:00.25Z"
EARLIER = "2026-01-01T09:59:59.75Z"


def published(ports: PortRange = RANGE, state: str = "running", busy: bool = False) -> HostState:
    """A host with a labelled ROS 2 container and a proxy with UDP ports."""
    parts: dict[str, Any] = running_proxy()
    (box,) = parts["sandboxes"]
    udp = frozenset(ports.ports())
    made = replace(box.container, state=state, udp_ports=udp, started_at=SANDBOX_STARTED)
    parts["sandboxes"] = [Sandbox(PLACE, made, ports, box.fingerprint)]
    names = frozenset({sandbox_name(PLACE)}) if busy else frozenset[str]()
    return observed(TALKER, busy=names, **parts)


def groups(state: HostState) -> list[Group]:
    plan = planned(state, SETTINGS, DockerMemory(), 100.0)
    return [group for group in plan.groups if group.subject.startswith("conntrack")]


def steps(state: HostState) -> list[Action]:
    return [action for group in groups(state) for action in group.actions]


def record(
    made: Creation, started_at: str = LATER, state: str = "exited", code: int = 0
) -> FlushContainer:
    own = container(made.name, own_labels(made), [], state, mode="host")
    own = replace(own, started_at=started_at, exit_code=code)
    return FlushContainer(made.place, own, made.range, made.fingerprint)


def wanted(state: HostState) -> CreateFlush:
    create, run = steps(state)
    assert isinstance(create, CreateFlush)
    assert run == Run(create.name)
    return create


MADE = wanted(published())


def test_it_runs_once_after_the_start_of_a_sandbox() -> None:
    assert (MADE.name, MADE.place, MADE.range) == (NAME, PLACE, RANGE)
    done = replace(published(), flushes=(record(MADE),))
    assert steps(done) == []


@pytest.mark.parametrize(
    "old",
    [
        record(MADE, EARLIER),
        record(MADE, SANDBOX_STARTED),
        record(MADE, code=1),
        record(MADE, "", state="created"),
        record(MADE, state="running"),
    ],
    ids=["earlier", "same moment", "failed", "created", "running"],
)
def test_it_runs_again_unless_it_ended_well_after_the_sandboxs_start(old: FlushContainer) -> None:
    """The engine may have started the sandbox anew, and the operator may have been killed."""
    assert steps(replace(published(), flushes=(old,))) == [Run(NAME)]


def test_the_flush_runs_again_once_when_the_engine_has_returned() -> None:
    """With live-restore the engine publishes the ports of a running sandbox again."""
    state = replace(published(), flushes=(record(MADE),))
    memory = DockerMemory(engine_returned=True)

    first = planned(state, SETTINGS, memory, 100.0)
    again = planned(state, SETTINGS, first.memory, 101.0)
    ran = replace(state, flushes=(record(MADE, "2026-01-01T10:00:07Z"),))
    later = planned(ran, SETTINGS, again.memory, 102.0)

    assert [plan.actions for plan in (first, again, later)] == [(Run(NAME),), (Run(NAME),), ()]


def test_a_longer_range_has_another_one() -> None:
    longer = PortRange(RANGE.first, RANGE.last + 8)
    state = replace(published(longer), flushes=(record(MADE),))
    remove, create, run = steps(state)
    assert remove == Remove(NAME, "outdated")
    assert isinstance(create, CreateFlush)
    assert (create.range, run) == (longer, Run(NAME))


def test_one_that_is_dead_is_made_anew() -> None:
    state = replace(published(), flushes=(record(MADE, state="dead"),))
    assert steps(state) == [Remove(NAME, "outdated"), MADE, Run(NAME)]


@pytest.mark.parametrize("state", ["created", "exited", "paused", "restarting"])
def test_it_waits_until_the_sandbox_runs(state: str) -> None:
    assert steps(published(state=state)) == []
    assert steps(replace(published(state=state), flushes=(record(MADE),))) == []


def test_it_waits_until_all_is_known() -> None:
    assert steps(published(busy=True)) == []
    assert steps(replace(published(), flushes=(record(MADE, state="removing"),))) == []
    busy = replace(published(), flushes=(record(MADE, EARLIER),), busy=frozenset({NAME}))
    assert steps(busy) == []


def test_without_an_image_none_is_made_and_one_that_is_there_still_runs() -> None:
    assert steps(replace(published(), image_id="")) == []


def test_a_proxy_of_tcp_ports_alone_has_none() -> None:
    assert steps(observed(container(), **both())) == []


def test_udp_ports_of_ros_1_are_flushed_whole() -> None:
    """No port of the range is a LAN relay's there."""
    parts = both()
    (box,) = parts["sandboxes"]
    made = replace(box.container, udp_ports=frozenset(RANGE.ports()))
    parts["sandboxes"] = [Sandbox(box.place, made, box.range, box.fingerprint)]
    create = wanted(observed(container(), **parts))
    assert flush_config(create, SETTINGS)["Cmd"][-2:] == [str(RANGE.first), str(RANGE.last)]


def test_an_engine_that_deletes_entries_by_itself_needs_none() -> None:
    newer = replace(published(), deletes_udp_entries=True)
    assert steps(newer) == []
    upgraded = replace(newer, flushes=(record(MADE),))
    assert steps(upgraded) == [Remove(NAME, "no longer needed")]


def test_the_record_goes_after_the_sandbox() -> None:
    state = replace(published(), containers=(), flushes=(record(MADE),))
    assert steps(state) == []
    gone = replace(state, sandboxes=(), proxies=(), lan_relays=())
    assert steps(gone) == [Remove(NAME, "no longer needed")]


def test_uninstalling_removes_the_record() -> None:
    uninstall = Uninstall()

    def look(state: HostState) -> DockerPlan:
        return uninstall(state, LabelReading(), SETTINGS, DockerMemory(), 0.0)

    state = replace(published(), flushes=(record(MADE),))
    assert NAME not in {action.name for action in look(state).actions}
    gone = replace(state, sandboxes=(), proxies=(), lan_relays=())
    assert [action.name for action in look(gone).actions] == [NAME]


def test_where_it_fails_users_are_told_the_command_and_nothing_else_waits() -> None:
    (group,) = groups(published())
    assert group.subject == f"conntrack entries for {proxy_name(PLACE)}"
    assert not group.fatal
    assert group.fix.startswith(
        f"Run as root: for port in $(seq {RANGE.first} {RANGE.last - 1}); "
        "do conntrack -D -p udp --orig-port-dst $port; done"
    )


def test_the_doctor_prints_the_command_as_a_warning() -> None:
    (group,) = groups(published())
    problem = Problem(group.subject, "ended with 1", group.fix, group.fatal, reason="X")
    status: dict[str, Any] = {"problems": [asdict(problem)], "proxies": [], "actions": []}
    status |= {"containers": [], "operator": None}
    (finding,) = host_findings(status)
    assert finding.severity is Severity.WARNING
    assert "conntrack -D -p udp --orig-port-dst $port" in finding.fix


def test_it_has_one_capability_in_the_hosts_network_and_bounds() -> None:
    config = flush_config(MADE, SETTINGS)
    assert config["User"] == "0:0"
    assert (config["Entrypoint"], config["Cmd"][0]) == (["/bin/sh"], "-ec")
    assert config["Cmd"][2:] == ["flush", str(RANGE.first), str(RANGE.last - 1)]
    assert config["HostConfig"] == {
        "ReadonlyRootfs": True,
        "CapDrop": ["ALL"],
        "CapAdd": ["NET_ADMIN"],
        "SecurityOpt": ["no-new-privileges:true"],
        "RestartPolicy": {"Name": "no"},
        "Init": False,
        "Memory": 64 * 1024**2,
        "PidsLimit": 16,
        "NetworkMode": "host",
    }
    assert forgery(inspection(config)) == ""


def forgery(making: dict[str, Any], name: str = NAME) -> str:
    own = read_own(own_labels(MADE))
    assert own is not None
    return forgery_reason(own, name, read_making(check_inspection(making)), IMAGE)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("NetworkMode", "container:id-talker"),
        ("CapAdd", ["NET_ADMIN", "SYS_ADMIN"]),
        ("CapAdd", None),
        ("SecurityOpt", None),
        ("PidMode", "host"),
        ("Binds", ["/:/host"]),
        ("ReadonlyRootfs", False),
        ("PortBindings", {"80/tcp": [{"HostPort": "80"}]}),
    ],
)
def test_what_gives_a_forged_one_away(field: str, value: object) -> None:
    making = inspection(flush_config(MADE, SETTINGS))
    making["HostConfig"][field] = value
    assert forgery(making) == f"HostConfig.{field} is not the operator's"


@pytest.mark.parametrize(
    "change",
    [
        {"Entrypoint": ["/bin/bash"]},
        {"Cmd": ["-c", "anything"]},
        {"Cmd": [*flush_config(MADE, SETTINGS)["Cmd"][:-1], "65535"]},
    ],
)
def test_it_runs_the_operators_command_for_its_own_ports_alone(change: dict[str, Any]) -> None:
    body = {**flush_config(MADE, SETTINGS), **change}
    assert forgery(inspection(body)) == "the command is not the operator's"
    assert forgery(inspection({**body, "User": "10001:10001"})) == "the user is not 0:0"
    assert forgery(inspection(body), "talker") == f"the name is not {NAME}"


def test_another_place_has_a_flush_of_its_own() -> None:
    place = Place(Domain(1), HERE)
    assert flush_name(place) != NAME
    other = structs.replace(MADE, place=place, name=flush_name(place))
    state = replace(published(), flushes=(record(MADE), record(other)))
    assert steps(state) == [Remove(other.name, "no longer needed")]
