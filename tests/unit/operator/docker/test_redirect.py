"""Redirect the address in a container's ROS_MASTER_URI to the proxy, in the container's network."""

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec import structs

from rosproxy_operator.docker.engine_json import read_making, signature
from rosproxy_operator.docker.planner.actions import Action, CreateRedirect, Remove, Run
from rosproxy_operator.docker.planner.model import (
    Attachment,
    Container,
    HostState,
    Proxy,
    RedirectContainer,
    Sandbox,
)
from rosproxy_operator.docker.planner.own_containers import forgery_reason
from rosproxy_operator.docker.planner.plan import DockerPlan
from rosproxy_operator.docker.planner.proxy_update import network_facts
from rosproxy_operator.docker.planner.redirect import redirect_config
from rosproxy_operator.docker.planner.specs import own_labels, proxy_name, read_own
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import Master, Place
from tests.unit.operator.docker.builders import (
    APP,
    HERE,
    IMAGE,
    RANGE,
    SETTINGS,
    UPLINK,
    both,
    container,
    inspection,
    observed,
    planned,
    read_members,
)
from tests.unit.operator.docker.hosts import Hosts, pick
from tests.unit.operator.docker.invariants import SETTINGS as FEW

ADDRESS = "192.0.2.7"
MASTER = f"http://{ADDRESS}:11311"
PLACE = Place(Master(MASTER), HERE)
LABELS = {"rosproxy.enable": "true"}
NEAR = "172.18.0.9"
OFF = replace(SETTINGS, redirect=False)


def node(name: str = "talker", env: str = MASTER, mode: str = "", **labels: str) -> Container:
    more = {f"rosproxy.{label.replace('_', '-')}": text for label, text in labels.items()}
    made = container(name, {**LABELS, **more}, env=env, mode=mode, networks=() if mode else ["app"])
    attachments = (Attachment("app", "172.18.0.3", frozenset({name})),)
    return replace(made, attachments=() if mode else attachments, started_at="2026-01-01T09:00:00Z")


def nodes_proxy(near: str = NEAR, proxy: str = "running", place: Place = PLACE) -> dict[str, Any]:
    """The nodes' proxy, with an address on the same network."""
    pair = both(place=place)
    (box,) = pair["sandboxes"]
    (process,) = pair["proxies"]
    attachments = [
        replace(a, address=near if a.network == "app" else "") for a in box.container.attachments
    ]
    box = Sandbox(place, replace(box.container, attachments=tuple(attachments)), box.range,
                  box.fingerprint)  # fmt: skip
    process = Proxy(place, replace(process.container, state=proxy), process.range,
                    process.fingerprint)  # fmt: skip
    return {"sandboxes": [box], "proxies": [process]}


def look(state: HostState, settings: PlanSettings = SETTINGS) -> DockerPlan:
    return planned(state, settings, DockerMemory(), 100.0)


def steps(state: HostState, settings: PlanSettings = SETTINGS) -> list[Action]:
    """The planned actions for redirects alone."""
    groups = look(state, settings).groups
    return [action for group in groups if group.subject for action in group.actions]


def wanted(state: HostState) -> CreateRedirect:
    create, run = steps(state)
    assert isinstance(create, CreateRedirect)
    assert run == Run(create.name)
    return create


def record(made: CreateRedirect, state: str = "exited", code: int = 0) -> RedirectContainer:
    own = Container(
        f"id-{made.name}", made.name, state, own_labels(made), f"container:{made.target}",
        exit_code=code,
    )  # fmt: skip
    return RedirectContainer(made.place, own, made.range, made.fingerprint)


def test_it_is_set_once_where_the_proxy_is_met() -> None:
    made = wanted(observed(node(), **nodes_proxy()))
    (master,) = made.addresses
    assert (str(master), str(made.proxy)) == (f"{ADDRESS}:11311", f"{NEAR}:11311")
    assert (made.target, made.started) == ("id-talker", "2026-01-01T09:00:00Z")

    plan = look(observed(node(), **nodes_proxy(), redirects=(record(made),)))
    assert (plan.actions, plan.problems) == ((), ())


@pytest.mark.parametrize("state", ["exited", "created", "running"])
def test_one_that_has_failed_or_not_run_is_run(state: str) -> None:
    made = wanted(observed(node(), **nodes_proxy()))
    redirect = record(made, state, int(state == "exited"))
    assert steps(observed(node(), **nodes_proxy(), redirects=(redirect,))) == [Run(made.name)]


def test_a_renamed_record_runs_and_is_removed_under_its_name() -> None:
    made = wanted(observed(node(), **nodes_proxy()))
    name = f"{made.name}-2"
    failed = record(structs.replace(made, name=name), code=1)
    assert steps(observed(node(), **nodes_proxy(), redirects=(failed,))) == [Run(name)]

    unwanted = observed(node(redirect="false"), **nodes_proxy(), redirects=(record(made),))
    removal = steps(unwanted)[0]
    assert isinstance(removal, CreateRedirect)
    failed = record(structs.replace(removal, name=f"{removal.name}-2"), code=1)
    state = replace(unwanted, redirects=(failed,))
    assert steps(state) == [Run(failed.container.name), Remove(failed.container.name, "done")]


def test_it_is_set_anew_for_another_start_and_another_address() -> None:
    old = wanted(observed(node(), **nodes_proxy()))
    later = replace(node(), started_at="2026-01-01T10:00:00Z")
    for state in (observed(later, **nodes_proxy()), observed(node(), **nodes_proxy("172.18.0.77"))):
        new = wanted(state)
        assert new.name != old.name
        assert steps(replace(state, redirects=(record(old),))) == [
            new, Run(new.name), Remove(old.name, "outdated"),
        ]  # fmt: skip


def test_it_is_not_set_without_a_proxy_and_stays_while_that_is_away() -> None:
    assert steps(observed(node())) == []
    assert steps(observed(node(), **nodes_proxy(proxy="exited"))) == []
    made = wanted(observed(node(), **nodes_proxy()))
    for state in (observed(node()), observed(node(), **nodes_proxy(proxy="exited"))):
        assert steps(replace(state, redirects=(record(made),))) == []


def test_where_it_can_not_be_set_a_name_is_the_fix() -> None:
    state = observed(node(), **nodes_proxy())
    (group,) = (g for g in look(state).groups if g.subject == "container talker")
    assert group.fix.startswith(
        f"Set ROS_MASTER_URI=http://{proxy_name(PLACE)}:11311 and the label "
        f"rosproxy.master-uri={MASTER}; or wait"
    )
    made = wanted(state)
    (undo,) = (
        g
        for g in look(replace(state, redirects=(record(made),)), OFF).groups
        if g.subject == "container talker"
    )
    assert undo.fix == ""


def test_it_is_taken_away_where_nobody_wants_it_any_more() -> None:
    made = wanted(observed(node(), **nodes_proxy()))
    state = observed(node(), **nodes_proxy(), redirects=(record(made),))
    by_label = replace(state, containers=(node(redirect="false"),))
    undo, *then = steps(state, OFF)
    assert steps(by_label) == [undo, *then]
    assert isinstance(undo, CreateRedirect)
    assert undo.addresses == ()
    assert then == [Run(undo.name), Remove(made.name, "outdated"), Remove(undo.name, "done")]
    assert steps(replace(state, redirects=(record(undo),)), OFF) == [Remove(undo.name, "done")]
    both_left = replace(state, redirects=(record(made), record(undo, "created")))
    assert steps(both_left, OFF) == then


def test_what_is_left_of_a_network_that_is_gone_is_removed() -> None:
    made = wanted(observed(node(), **nodes_proxy()))
    gone = [Remove(made.name, "the network namespace is gone")]
    assert steps(observed(**nodes_proxy(), redirects=(record(made),))) == gone
    ended = replace(node(), state="exited")
    assert steps(observed(ended, **nodes_proxy(), redirects=(record(made),))) == gone


def test_nothing_is_done_to_what_the_engine_is_at() -> None:
    made = wanted(observed(node(), **nodes_proxy()))
    assert steps(observed(**nodes_proxy(), redirects=(record(made, "removing"),))) == []
    busy = frozenset({made.name})
    assert steps(observed(**nodes_proxy(), redirects=(record(made),), busy=busy)) == []


def test_one_that_is_dead_is_made_anew() -> None:
    made = wanted(observed(node(), **nodes_proxy()))
    state = observed(node(), **nodes_proxy(), redirects=(record(made, "dead"),))
    assert steps(state) == [Remove(made.name, "dead"), made, Run(made.name)]


def test_without_an_image_all_stays() -> None:
    made = wanted(observed(node(), **nodes_proxy()))
    state = observed(node(), **nodes_proxy(), redirects=(record(made),), image="")
    assert (steps(state), steps(state, OFF)) == ([], [])


def test_containers_that_share_a_network_have_it_once() -> None:
    owner = replace(node("box"), labels={}, master_uri="")
    guests = [node(name, mode="container:id-box") for name in ("one", "other")]
    made = wanted(observed(owner, *guests, **nodes_proxy()))
    assert made.target == "id-box"


@pytest.mark.parametrize("address", [ADDRESS, "192.0.2.8"])
def test_a_masters_name_may_be_known_by_an_address(address: str) -> None:
    """Also by a former address of the master: the nodes keep the variable."""
    by_name = Place(Master("http://robot:11311"), HERE)
    talker = node(master_uri="http://robot:11311")
    state = observed(talker, **nodes_proxy(place=by_name), masters={"robot": address})
    assert [*map(str, wanted(state).addresses)] == [f"{ADDRESS}:11311"]


@pytest.mark.parametrize(
    ("talker", "settings", "text"),
    [
        (node(env="http://192.0.2.8:11311", master_uri=MASTER), SETTINGS, "name of the master"),
        (node(env="http://192.0.2.7:11399", master_uri=MASTER), SETTINGS, "name of the master"),
        (node(env="http://[2001:db8::7]:11311"), SETTINGS, "name of the master's host"),
        (node(env="http://127.0.0.1:11311", master_uri="http://robot:11311"), SETTINGS, "itself"),
        (node(redirect="false"), SETTINGS, "Or remove label rosproxy.redirect='false'"),
        (node(redirect="true"), OFF, "start the operator without --no-redirect"),
        (node(redirect="perhaps"), SETTINGS, "neither true nor false. Write rosproxy.redirect="),
    ],
)
def test_who_is_not_redirected_is_told(
    talker: Container, settings: PlanSettings, text: str
) -> None:
    members, problems = read_members(observed(talker), settings)
    assert text in " ".join(problem.message for problem in problems)
    assert not any(member.redirected for member in members)


@pytest.mark.parametrize(
    ("entry", "redirected"), [(ADDRESS, [f"{ADDRESS}:11311"]), ("host-gateway", []), ("", [])]
)
def test_a_container_may_know_the_master_by_its_hosts_file(
    entry: str, redirected: list[str]
) -> None:
    """The alias of the proxy had no effect, and nothing was told."""
    talker = replace(node(env="http://robot:11311"), master_entry=entry)
    members, problems = read_members(observed(talker, masters={"robot": ADDRESS}))
    (member,) = members
    assert [*map(str, member.redirected)] == redirected
    told = [p.message for p in problems if "leads past the proxy: /etc/hosts" in p.message]
    assert bool(told) == (entry == "host-gateway")
    assert all("Remove robot from extra_hosts of the service" in text for text in told)


@pytest.mark.parametrize("labels", [{}, {"master_uri": "http://host.docker.internal:11311"}])
def test_the_hosts_entry_of_this_host_has_to_stay(labels: dict[str, str]) -> None:
    """The fix was to remove the entry. No proxy gets this name, so the nodes found no master."""
    uri = "http://host.docker.internal:11311"
    talker = replace(node(env=uri, **labels), master_entry="host-gateway")
    _, problems = read_members(observed(talker, masters={"host.docker.internal": ADDRESS}))
    (text,) = (p.message for p in problems if "leads past the proxy: /etc/hosts" in p.message)
    assert "Remove" not in text
    ending = "" if labels else f" and the label rosproxy.master-uri={uri}"
    assert text.endswith(f"Set ROS_MASTER_URI=http://rosproxy:11311{ending}")


def test_a_label_can_not_widen() -> None:
    _, problems = read_members(observed(node(redirect="true")), OFF)
    assert any("rosproxy.redirect=true is ignored" in problem.message for problem in problems)


def test_without_a_way_outwards_nothing_is_redirected() -> None:
    cell = replace(APP, internal=True)
    (member,), (problem,) = read_members(observed(node(), networks=[UPLINK, cell]))
    assert not member.redirected
    assert "all networks of the container are internal" in problem.message


def test_a_master_that_is_not_allowed_is_not_redirected() -> None:
    members, (problem,) = read_members(observed(node()), replace(SETTINGS, allow_master=("a:1",)))
    assert not members
    assert "--allow-master" in problem.message


def test_its_nodes_arrive_once_more_when_it_is_there() -> None:
    made = wanted(observed(node(), **nodes_proxy()))
    members, _ = read_members(observed(node(), **nodes_proxy()))

    def arrivals(*records: RedirectContainer) -> Any:
        state = observed(node(), **nodes_proxy(), redirects=records)
        return network_facts(state, state.proxies[0], members).arrivals

    assert len(arrivals() | arrivals(record(made))) == 2
    assert arrivals() == arrivals(record(made, code=1))


MADE = structs.replace(wanted(observed(node(), **nodes_proxy())), range=RANGE)


def test_it_has_one_capability_and_bounds() -> None:
    config = redirect_config(MADE, SETTINGS)
    assert config["User"] == "0:0"
    assert config["Entrypoint"] == ["/usr/sbin/nft"]
    assert config["HostConfig"] == {
        "ReadonlyRootfs": True,
        "CapDrop": ["ALL"],
        "CapAdd": ["NET_ADMIN"],
        "SecurityOpt": ["no-new-privileges:true"],
        "RestartPolicy": {"Name": "no"},
        "Init": False,
        "Memory": 64 * 1024**2,
        "PidsLimit": 16,
        "NetworkMode": "container:id-talker",
    }
    own = read_own(config["Labels"])
    assert own is not None
    assert not forgery_reason(own, MADE.name, read_making(inspection(config)), IMAGE)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("NetworkMode", "host"),
        ("CapAdd", ["NET_ADMIN", "SYS_ADMIN"]),
        ("CapAdd", None),
        ("SecurityOpt", None),
        ("PidMode", "host"),
        ("Binds", ["/:/host"]),
        ("ReadonlyRootfs", False),
        ("PortBindings", {"80/tcp": [{"HostPort": "80"}]}),
        ("Sysctls", {"net.ipv4.conf.all.route_localnet": "1"}),
    ],
)
def test_what_gives_a_forged_one_away(field: str, value: object) -> None:
    making = inspection(redirect_config(MADE, SETTINGS))
    making["HostConfig"][field] = value
    own = read_own(own_labels(MADE))
    assert own is not None
    reason = forgery_reason(own, MADE.name, read_making(making), IMAGE)
    assert reason == f"HostConfig.{field} is not the operator's"


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"Entrypoint": ["/bin/sh"]}, "the command is not /usr/sbin/nft"),
        ({"User": "10001:10001"}, "the user is not 0:0"),
    ],
)
def test_what_an_image_says_gives_it_away_as_well(change: dict[str, Any], text: str) -> None:
    making = inspection({**redirect_config(MADE, SETTINGS), **change})
    own = read_own(own_labels(MADE))
    assert own is not None
    assert forgery_reason(own, MADE.name, read_making(making), IMAGE) == text
    assert forgery_reason(own, "talker", read_making(making), IMAGE).startswith("the name is not")


def test_the_end_of_a_container_without_a_network_shows_in_the_list() -> None:
    assert signature({"State": "running"}) != signature({"State": "exited"})


# whatever happens


class Addressed(Hosts):
    """A host where every ROS_MASTER_URI has an address, and --redirect may change."""

    def come(self, n: int, m: int) -> None:
        if len(self.strangers()) > 4:
            return
        label = {"rosproxy.redirect": "false"} if n % 5 == 1 else {}
        box = self.engine.add(
            f"node{next(self.engine.ids)}",
            env="http://192.0.2.9:11402",
            labels={"rosproxy.enable": "true", **label},
        )
        self.engine.join(box, pick(("app", "lab"), n))
        self.engine.begin(box, pick(("running", "running", "exited"), m))

    def switch(self, n: int, _: int) -> None:
        self.controller.settings = replace(FEW, redirect=bool(n & 1))


EVENTS = st.tuples(
    st.sampled_from(
        [
            *(Addressed.come, Addressed.switch, Addressed.share, Addressed.change),
            *(Addressed.fail_redirects, Addressed.attach, Addressed.detach, Addressed.remove),
            *(Addressed.meddle, Addressed.break_one, Addressed.remove_own, Addressed.look),
            *(Addressed.look_and_be_killed, Addressed.look_and_stall, Addressed.come_to_rest),
            *(Addressed.change_image, Addressed.engine_restarts, Addressed.start_by_hand),
        ]
    ),
    st.integers(0, 59),
    st.integers(0, 59),
)


STARTED_ANEW = [
    (Addressed.come, 0, 0),
    (Addressed.switch, 0, 0),
    (Addressed.change, 0, 1),
    (Addressed.change, 0, 0),
    (Addressed.start_by_hand, 0, 0),
]
"""A record of the container's former start, started by hand: the rules are in the current
namespace.
"""
OUTDATED_STARTED = [
    (Addressed.come, 0, 2),
    (Addressed.meddle, 0, 0),
    (Addressed.look, 0, 0),
    (Addressed.look_and_be_killed, 2, 0),
    (Addressed.start_by_hand, 0, 0),
]
"""The same for a record with a former address of the proxy."""


@given(st.lists(EVENTS, min_size=5, max_size=25))
@example(STARTED_ANEW)
@example(OUTDATED_STARTED)
def test_redirects_come_to_rest_as_wished(events: list) -> None:
    host = Addressed()
    host.come(0, 0)
    host.come_to_rest()
    assert host.engine.rules
    for happen, n, m in events:
        happen(host, n, m)
        host.check()
    host.come_to_rest()
    host.engine.image = "image-1"
    host.come_to_rest()


def test_the_rules_name_one_address_and_port() -> None:
    rules, none = (
        redirect_config(made, SETTINGS)["Cmd"][0]
        for made in (MADE, structs.replace(MADE, addresses=(), proxy=None))
    )
    assert rules.startswith(none)
    assert none.count("\n") == 2
    assert rules.count("dnat to") == 1
    assert f"ip daddr {ADDRESS} tcp dport 11311 dnat to {NEAR}:11311" in rules
