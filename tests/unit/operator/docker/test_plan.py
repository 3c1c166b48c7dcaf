"""The order of actions, rule by rule. test_plan_convergence checks the end."""

from dataclasses import replace
from typing import Any

import pytest
from msgspec import structs

from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.port_ranges import Move
from rosproxy_operator.common.problem import ends_again
from rosproxy_operator.docker.planner.actions import (
    Action,
    Connect,
    Create,
    CreateNetwork,
    CreateSandbox,
    Disconnect,
    Remove,
    Rename,
    Restart,
    Start,
    Unpause,
)
from rosproxy_operator.docker.planner.model import THIS_HOST, Container, HostState, Network, Proxy
from rosproxy_operator.docker.planner.plan import DockerPlan
from rosproxy_operator.docker.planner.specs import (
    proxy_fingerprint,
    proxy_name,
    sandbox_fingerprint,
    sandbox_name,
)
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import Master, Place
from tests.unit.operator.docker.builders import (
    APP,
    ENABLED,
    HERE,
    IMAGE,
    PLACE,
    RANGE,
    SECRET,
    SETTINGS,
    UPLINK,
    attachment,
    both,
    container,
    observed,
    planned,
    proxy,
    sandbox,
)

NAME = proxy_name(PLACE)
PORTS = sandbox_name(PLACE)
ALIASES = ("robot", "rosproxy", NAME)
ARM = Place(Master("http://arm:11311"), HERE)
ON_ARM = {**ENABLED, "rosproxy.master-uri": ARM.master.uri}
LAB = Network("n2", "lab")
NEXT = PortRange(11432, 11463)
WITH_ROOM = PortRange(11464, 11495)
"""The next range that leaves both proxies room to have twice as many ports."""
ELSEWHERE = PortRange(11500, 11531)
LONGER = PortRange(11400, 11439)
ASKS_FOR_40 = {**ENABLED, "rosproxy.ports": "40"}


def new_sandbox(ports: PortRange = RANGE, name: str = PORTS) -> CreateSandbox:
    made = CreateSandbox(name, PLACE, ports)
    return structs.replace(made, fingerprint=sandbox_fingerprint(made, SETTINGS))


def new_proxy(
    ports: PortRange = RANGE, replaces: str = "", image: str = IMAGE, home: str = PORTS
) -> Create:
    made = Create(NAME, PLACE, ports, home, replaces=replaces)
    return structs.replace(made, fingerprint=proxy_fingerprint(made, SETTINGS, image, SECRET))


def look(
    seen: HostState,
    memory: DockerMemory | None = None,
    now: float = 0.0,
    settings: PlanSettings = SETTINGS,
) -> DockerPlan:
    return planned(seen, settings, memory or DockerMemory(), now)


def actions(seen: HostState, **more: Any) -> list[Action]:
    return list(look(seen, **more).actions)


def texts(plan: DockerPlan) -> list[str]:
    return [problem.message for problem in plan.problems]


FIRST = [
    new_sandbox(), Start(PORTS), Connect(PORTS, "app", ALIASES), new_proxy(), Start(NAME),
]  # fmt: skip
ANEW = [
    Remove(NAME, "the sandbox is replaced", stop=True),
    Remove(f"{PORTS}-old", "replaced by another container"),
    Start(PORTS),
    Connect(PORTS, "app", ALIASES),
    new_proxy(LONGER, replaces=NAME),
    Start(NAME),
]
"""The end of the steps that give a proxy more ports."""


def test_the_first_container_on_a_host() -> None:
    plan = look(observed(container(), networks=[APP]))
    assert list(plan.actions) == [CreateNetwork("0-rosproxy"), *FIRST]
    assert [group.place for group in plan.groups] == [None, PLACE]
    assert (plan.problems, plan.again_in) == ((), None)


def labelled(master: str) -> Container:
    return container(labels={"rosproxy.enable": "true", "rosproxy.master-uri": master})


def test_a_master_on_this_host_needs_the_network_of_the_proxies_first() -> None:
    """On a fresh host, no proxy was made: the address of the host is known by that network."""
    talker = labelled(f"http://{THIS_HOST}:11311")
    settings = replace(SETTINGS, advertise_host="")
    plan = look(observed(talker, networks=[APP], masters={THIS_HOST: ""}), settings=settings)
    assert list(plan.actions) == [CreateNetwork("0-rosproxy")]
    assert all("/etc/hosts" not in text for text in texts(plan))


def test_a_master_in_a_stopped_container_is_no_matter_of_etc_hosts() -> None:
    talker = labelled("http://roscore:11311")
    roscore = container("roscore", {}, state="exited")
    (text, *_) = texts(look(observed(talker, roscore, masters={"roscore": ""})))
    assert "the container roscore is exited. Start the container: docker start roscore" in text


def test_another_secret_makes_the_process_anew_in_its_sandbox() -> None:
    """The sandbox stays, so the nodes keep their ports and networks."""
    plan = look(observed(container(), **both(), secret="another"))
    assert [(type(action), action.name) for action in plan.actions] == [
        (Rename, NAME),
        (Create, NAME),
        (Remove, f"{NAME}-old"),
        (Start, NAME),
    ]
    assert [action.range for action in plan.actions if isinstance(action, Create)] == [RANGE]


@pytest.mark.parametrize(
    "seen",
    [observed(container(), **both()), observed(container(labels={}), networks=[APP])],
    ids=["all is in order", "no container has a label"],
)
def test_nothing_is_to_be_done(seen: HostState) -> None:
    plan = look(seen)
    assert (plan.actions, plan.problems, plan.again_in) == ((), (), None)


def test_a_controller_killed_after_any_step_goes_on() -> None:
    """Completed steps are not repeated."""
    created = sandbox(networks=(), state="created", started_at="")
    started = sandbox(networks=())
    made = proxy(state="created", started_at="")
    for existing, left in (
        ({}, FIRST),
        ({"sandboxes": [created]}, FIRST[1:]),
        ({"sandboxes": [started]}, FIRST[2:]),
        ({"sandboxes": [sandbox()]}, FIRST[3:]),
        ({"sandboxes": [sandbox()], "proxies": [made]}, FIRST[4:]),
    ):
        assert actions(observed(container(), **existing)) == left


# networks


def test_networks_are_joined_and_left() -> None:
    seen = observed(container(networks=("lab",)), networks=[UPLINK, APP, LAB], **both())
    plan = look(seen)
    assert list(plan.actions) == [Disconnect(PORTS, "app"), Connect(PORTS, "lab", ALIASES)]
    assert len(plan.groups) == 2


def test_the_last_one_leaves() -> None:
    """`docker compose down` can then remove the network. The proxy stays for the grace."""
    plan = look(observed(**both()))
    assert list(plan.actions) == [Disconnect(PORTS, "app")]
    assert plan.again_in == 60.0


def test_the_uplink_is_joined_again() -> None:
    bare = sandbox()
    bare = replace(
        bare, container=replace(bare.container, attachments=(attachment("app", *ALIASES),))
    )
    seen = observed(container(), networks=[APP], sandboxes=[bare], proxies=[proxy()])
    assert actions(seen) == [CreateNetwork("0-rosproxy"), Connect(PORTS, "0-rosproxy", ())]


def test_a_missing_name_that_somebody_looks_for() -> None:
    existing: Any = {
        "sandboxes": [sandbox(networks=[attachment("app", "robot")])],
        "proxies": [proxy()],
    }
    again = [Disconnect(PORTS, "app"), Connect(PORTS, "app", ALIASES)]
    assert actions(observed(container(), **existing)) == again
    assert actions(observed(container(env=PLACE.master.uri), **existing)) == []


def test_a_name_that_another_one_has_now_is_not_taken_again() -> None:
    robot = container("robot", {})
    stopped = sandbox(state="exited")
    seen = observed(container(), robot, sandboxes=[stopped], proxies=[proxy()])
    assert Connect(PORTS, "app", ("rosproxy", NAME)) in actions(seen)


# sandboxes that do not run


def test_a_sandbox_that_has_stopped_is_started_without_networks() -> None:
    """The engine joins networks in any order, and might publish the ports on the wrong network."""
    seen = observed(container(), sandboxes=[sandbox(state="exited")], proxies=[proxy()])
    assert actions(seen) == [
        Disconnect(PORTS, "app"),
        Start(PORTS),
        Connect(PORTS, "app", ALIASES),
        Restart(NAME),
    ]


@pytest.mark.parametrize("network_id", ["other", "n1"])
def test_a_sandbox_on_a_network_that_was_made_anew_is_made_anew(network_id: str) -> None:
    stopped = sandbox(networks=[attachment("app", network_id=network_id)], state="exited")
    seen = observed(container(), sandboxes=[stopped])
    anew = [
        Rename(PORTS, f"{PORTS}-old"),
        new_sandbox(),
        Remove(f"{PORTS}-old", "replaced by another container"),
        *FIRST[1:],
    ]
    usual = [Disconnect(PORTS, "app"), *FIRST[1:]]
    assert actions(seen) == (usual if network_id == "n1" else anew)


@pytest.mark.parametrize(
    ("existing", "done", "again_in", "told"),
    [
        ([sandbox(state="paused"), proxy()], [Unpause(PORTS)], None, []),
        (
            [sandbox(state="restarting", networks=())],
            [],
            None,
            [str(ends_again("the engine restarts it", f"docker logs {PORTS}"))],
        ),
        ([sandbox(state="removing"), proxy()], [], 1.0, []),
        ([sandbox(state="dead")], [Remove(PORTS, "left over"), *FIRST], None, []),
    ],
    ids=["paused", "restarting", "removing", "dead"],
)
def test_a_sandbox_that_does_not_run(
    existing: list, done: list[Action], again_in: float | None, told: list[str]
) -> None:
    plan = look(observed(container(), sandboxes=existing[:1], proxies=existing[1:]))
    assert (list(plan.actions), plan.again_in, texts(plan)) == (done, again_in, told)


# proxies that do not run


@pytest.mark.parametrize(
    ("state", "done"),
    [
        ("exited", [Start(NAME)]),
        ("created", [Start(NAME)]),
        ("paused", [Unpause(NAME)]),
        ("restarting", []),
        ("dead", [Remove(NAME, "left over"), new_proxy(), Start(NAME)]),
        ("removing", []),
    ],
)
def test_a_proxy_that_does_not_run(state: str, done: list[Action]) -> None:
    plan = look(observed(container(), sandboxes=[sandbox()], proxies=[proxy(state=state)]))
    assert list(plan.actions) == done
    assert plan.again_in == (1.0 if state == "removing" else None)


@pytest.mark.parametrize(
    ("proxys", "sandboxs", "lost"),
    [
        ("10:00:01Z", "10:00:00Z", False),
        ("10:00:00Z", "10:00:01Z", True),
        ("10:00:00.12Z", "10:00:00.115Z", False),
        ("10:00:00.12Z", "10:00:00.1234Z", True),
        ("10:00:00Z", "10:00:00.1Z", True),
        ("", "10:00:00.1Z", False),
        ("10:00:00Z", "", False),
    ],
)
def test_a_proxy_in_a_namespace_that_is_gone(proxys: str, sandboxs: str, lost: bool) -> None:
    day = "2026-01-01T"
    seen = observed(
        container(),
        sandboxes=[sandbox(started_at=sandboxs and day + sandboxs)],
        proxies=[proxy(started_at=proxys and day + proxys)],
    )
    assert actions(seen) == ([Restart(NAME)] if lost else [])


# replacement


def replacement(image: str = IMAGE, reason: str = "replaced by another container") -> list[Action]:
    old = f"{NAME}-old"
    return [
        Rename(NAME, old),
        new_proxy(replaces=old, image=image),
        Remove(old, reason),
        Start(NAME),
    ]


def test_what_replaces_the_proxy_and_not_the_sandbox() -> None:
    assert actions(observed(container(), image="new", **both())) == replacement("new")
    in_another = proxy(sandbox_id="gone")
    seen = observed(container(), sandboxes=[sandbox()], proxies=[in_another])
    assert actions(seen) == replacement()


def test_a_proxy_that_has_retired_in_vain_is_replaced() -> None:
    """A container is labelled again before the proxy is removed. The ports stay."""
    reason = "the proxy has unregistered its nodes, and accepts no others"
    retired = frozenset({NAME})
    assert actions(observed(container(), retired=retired, **both())) == replacement(reason=reason)
    without_image = observed(container(), image="", retired=retired, **both())
    assert actions(without_image) == []
    kept = [proxy(name=f"{NAME}-old"), proxy()]
    seen = observed(container(), retired={f"{NAME}-old"}, sandboxes=[sandbox()], proxies=kept)
    assert actions(seen) == [Remove(f"{NAME}-old", "left over")]


def test_a_controller_killed_while_replacing_goes_on() -> None:
    old = proxy(name=f"{NAME}-old")
    new = proxy(image="new", state="created", started_at="")
    for proxies, left in (
        ([old], [new_proxy(replaces=f"{NAME}-old", image="new"), *replacement()[2:]]),
        ([old, new], [Remove(f"{NAME}-old", "replaced by another container"), Start(NAME)]),
        ([new], [Start(NAME)]),
    ):
        seen = observed(container(), image="new", sandboxes=[sandbox()], proxies=proxies)
        assert actions(seen) == left


@pytest.mark.parametrize(
    ("proxies", "done"),
    [
        ([proxy(name=f"{NAME}-old")], Rename(f"{NAME}-old", NAME)),
        ([proxy(name="other"), proxy()], Remove("other", "left over")),
    ],
    ids=["an old proxy that is right gets its name back", "of two that run, the wrong one goes"],
)
def test_what_a_controller_that_was_killed_leaves(proxies: list[Proxy], done: Action) -> None:
    assert actions(observed(container(), sandboxes=[sandbox()], proxies=proxies)) == [done]


def test_other_ports_replace_both() -> None:
    steps = actions(observed(container(labels=ASKS_FOR_40), **both()))
    assert steps == [Rename(PORTS, f"{PORTS}-old"), new_sandbox(LONGER), *ANEW]


def test_a_controller_killed_before_the_old_sandbox_went_goes_on() -> None:
    """The proxy goes first: without a network the proxy cannot close connections."""
    old = sandbox(name=f"{PORTS}-old")
    new = sandbox(ports=LONGER, state="created", networks=())
    lives = proxy(sandbox_id=old.container.id)
    seen = observed(container(labels=ASKS_FOR_40), sandboxes=[old, new], proxies=[lives])
    gone = Remove(f"{PORTS}-old", "replaced by another container")
    assert actions(seen) == [ANEW[0], gone, *ANEW[2:]]


def test_another_publish_address_replaces_both() -> None:
    settings = replace(SETTINGS, publish_address=("192.0.2.10",))
    steps = actions(observed(container(), **both()), settings=settings)
    assert steps[0] == Rename(PORTS, f"{PORTS}-old")
    assert steps[2] == Remove(NAME, "the sandbox is replaced", stop=True)


def test_names_of_strangers_are_left_to_them() -> None:
    strangers = [container(PORTS, {}), container(NAME, {})]
    steps = actions(observed(container(), *strangers))
    assert steps[0] == new_sandbox(name=f"{PORTS}-2")
    assert steps[1] == Start(f"{PORTS}-2")
    assert Start(f"{NAME}-2") in steps


# image and uplink


def test_without_an_image_nothing_is_created() -> None:
    plan = look(observed(container(), image=""))
    assert plan.actions == ()
    assert [(problem.subject, problem.fatal) for problem in plan.problems] == [
        ("proxy image rosproxy:latest", True)
    ]
    assert "not on this host. Run docker pull rosproxy:latest" in texts(plan)[0]
    assert "docker build --target proxy" in texts(plan)[0]


def test_without_an_image_everything_is_kept() -> None:
    settings = replace(SETTINGS, publish_address=("::",), ports=40)
    plan = look(observed(container(), image="", **both()), settings=settings)
    assert plan.actions == ()
    assert [problem.fatal for problem in plan.problems] == [False]
    stopped: Any = {"sandboxes": [sandbox(state="exited")], "proxies": [proxy(state="exited")]}
    assert actions(observed(container(), image="", **stopped)) == [
        Disconnect(PORTS, "app"),
        Start(PORTS),
        Connect(PORTS, "app", ALIASES),
        Start(NAME),
    ]


@pytest.mark.parametrize(
    "uplink", [replace(UPLINK, internal=True), replace(UPLINK, driver="ipvlan")]
)
def test_an_uplink_that_is_none(uplink: Network) -> None:
    plan = look(observed(container(), networks=[uplink, APP]))
    assert plan.actions == ()
    assert "can't be the uplink of the proxies" in texts(plan)[0]


# the end


UNWANTED = "no running container needs the proxy"
ALONE: Any = {"sandboxes": [sandbox(networks=())], "proxies": [proxy()]}


def test_the_grace() -> None:
    first = look(observed(**ALONE))
    assert (first.actions, first.again_in) == ((), 60.0)
    second = look(observed(**ALONE), memory=first.memory, now=59.5)
    assert (second.actions, second.again_in) == ((), 0.5)
    third = look(observed(**ALONE), memory=second.memory, now=60.0)
    assert list(third.actions) == [Remove(NAME, UNWANTED, retire=True), Remove(PORTS, UNWANTED)]
    assert third.again_in is None
    assert look(observed(), memory=third.memory, now=61.0).memory == DockerMemory()


def test_the_grace_begins_anew_with_each_container() -> None:
    memory = look(observed(**ALONE)).memory
    memory = look(observed(container(), **both()), memory=memory, now=50.0).memory
    assert look(observed(**ALONE), memory=memory, now=70.0).again_in == 60.0


@pytest.mark.parametrize("state", ["exited", "paused", "created", "restarting"])
def test_what_does_not_run_goes_too(state: str) -> None:
    settings = replace(SETTINGS, grace=0.0)
    seen = observed(sandboxes=[sandbox(networks=(), state=state)], proxies=[proxy(state=state)])
    steps = actions(seen, settings=settings)
    removals = [Remove(NAME, UNWANTED, retire=state == "paused"), Remove(PORTS, UNWANTED)]
    assert steps == ([Unpause(NAME), *removals] if state == "paused" else removals)


def test_a_container_that_has_exited_keeps_its_network_for_the_grace() -> None:
    seen = observed(container(state="exited"), **both())
    first = look(seen)
    assert (first.actions, first.again_in) == ((), 60.0)
    after = look(seen, memory=first.memory, now=60.0)
    assert [type(action) for action in after.actions] == [Remove, Remove]


# ports


def port_problem(plan: DockerPlan) -> str:
    return next(problem.message for problem in plan.problems if problem.subject == f"proxy {NAME}")


def created(plan: DockerPlan) -> PortRange:
    return next(iter(ranges(plan).values()))


def ranges(plan: DockerPlan) -> dict[Place, PortRange]:
    return {a.place: a.range for a in plan.actions if isinstance(a, CreateSandbox)}


@pytest.mark.parametrize(
    ("seen", "first"),
    [
        (observed(container()), 11400),
        (observed(container(ports=[11405])), 11406),
        (observed(container(), container("web", {}, state="created", ports=[11405])), 11406),
        (observed(container(), container("web", {}, state="exited", ports=[11431])), 11432),
        (observed(container(), listening=[11400, 11410]), 11411),
        (observed(container(), ephemeral=PortRange(10000, 20000)), 20001),
        (observed(container(), **both(place=ARM)), WITH_ROOM.first),
        (observed(container(), sandboxes=[sandbox(ARM, state="created")]), WITH_ROOM.first),
    ],
)
def test_new_ports_are_nobodys(seen: HostState, first: int) -> None:
    assert created(look(seen)) == PortRange(first, first + 31)


def test_ports_on_which_the_proxy_itself_listens_are_not_in_its_range() -> None:
    labels = {**ENABLED, "rosproxy.master-uri": "http://robot:11405"}
    assert created(look(observed(container(labels=labels)))).first == 11406


def test_two_new_proxies_do_not_get_the_same_ports() -> None:
    """A proxy keeps its promised ports while its container is being created."""
    plan = look(observed(container(), container("b", ON_ARM)))
    assert ranges(plan) == {ARM: RANGE, PLACE: WITH_ROOM}
    memory = look(observed(container())).memory
    plan = look(observed(container(), container("a", ON_ARM)), memory=memory)
    assert ranges(plan) == {ARM: WITH_ROOM, PLACE: RANGE}


def test_a_sandbox_that_the_engine_is_just_starting_keeps_its_ports() -> None:
    """The sandbox does not run yet, but the ports are already taken, by the sandbox itself."""
    starting = sandbox(state="created", networks=())
    for memory in (None, look(observed(container())).memory):
        plan = look(
            observed(container(), sandboxes=[starting], listening=RANGE.ports()), memory=memory
        )
        assert plan.actions[0] == Start(PORTS)
        assert plan.problems == ()


def test_ports_are_kept_when_everything_was_removed_by_hand() -> None:
    """The program that listens there may be a remainder of the proxy."""
    memory = look(observed(container(), **both(ports=ELSEWHERE))).memory
    plan = look(observed(container(), listening=ELSEWHERE.ports()), memory=memory)
    assert created(plan) == ELSEWHERE


def test_ports_are_kept_when_one_was_removed_and_nothing_is_remembered() -> None:
    seen = observed(container(), sandboxes=[sandbox(ports=ELSEWHERE)])
    assert actions(seen) == [new_proxy(ELSEWHERE), Start(NAME)]
    # A proxy without its sandbox is useless, but has the range in its labels.
    assert created(look(observed(container(), proxies=[proxy(ports=ELSEWHERE)]))) == ELSEWHERE


def test_a_stopped_sandbox_tells_more_than_memory_only_if_it_has_more_ports() -> None:
    for ports, expected in (
        (PortRange(11400, 11439), PortRange(11400, 11439)),
        (PortRange(11500, 11531), RANGE),
    ):
        seen = observed(container(), sandboxes=[sandbox(ports=ports, state="exited")])
        plan = look(seen, memory=DockerMemory(served={PLACE: RANGE}))
        assert plan.memory.planned == {PLACE: expected}


def test_never_fewer_ports() -> None:
    assert actions(observed(container(), **both()), settings=replace(SETTINGS, ports=8)) == []


def test_more_ports_that_can_not_be_had() -> None:
    plan = look(observed(container(labels=ASKS_FOR_40), listening=[11435], **both()))
    assert plan.actions == ()
    assert "asks for 40: " in port_problem(plan)
    text = "has only the 32 ports 11400-11431, although --ports or the label rosproxy.ports asks"
    assert text in port_problem(plan)
    text = "11432-11439 are not all free. Stop the programs that hold these ports"
    assert text in port_problem(plan)


def test_more_ports_that_lie_in_the_kernels_range() -> None:
    seen = observed(container(labels=ASKS_FOR_40), **both())
    plan = look(replace(seen, ephemeral=PortRange(11432, 60999)))
    text = "11432-11439 lie in the kernel's range of ephemeral ports (11432-60999). Give --port-"
    assert text in port_problem(plan)
    assert "Stop the programs" not in port_problem(plan)


def test_more_ports_where_the_next_proxy_begins() -> None:
    neighbour: Any = both(place=ARM, ports=NEXT)
    own: Any = both()
    seen = observed(
        container(labels=ASKS_FOR_40),
        container("b", ON_ARM),
        sandboxes=[*own["sandboxes"], *neighbour["sandboxes"]],
        proxies=[*own["proxies"], *neighbour["proxies"]],
    )
    plan = look(seen)
    text = f"proxy {proxy_name(ARM)} has 11432-11463. Stop the containers of that proxy"
    assert text in port_problem(plan)


def test_more_ports_beyond_the_window() -> None:
    settings = replace(SETTINGS, port_window=PortRange(11400, 11435))
    plan = look(observed(container(labels=ASKS_FOR_40), **both()), settings=settings)
    text = "ports 11432-11439 are beyond --port-window (11400-11435). Widen --port-window"
    assert text in port_problem(plan)


def test_two_proxies_may_both_have_twice_as_many_ports() -> None:
    plan = look(observed(container(), container("b", ON_ARM)))
    assert {*ranges(plan).values()} == {RANGE, WITH_ROOM}
    settings = replace(SETTINGS, port_window=PortRange(11400, 11463))
    plan = look(observed(container(), container("b", ON_ARM)), settings=settings)
    assert {*ranges(plan).values()} == {RANGE, NEXT}, "a narrow window has no room to leave"


def test_exhausted() -> None:
    settings = replace(SETTINGS, port_window=PortRange(11400, 11430))
    plan = look(observed(container()), settings=settings)
    assert plan.actions == ()
    assert port_problem(plan) == (
        "no 32 free ports in a row between 11400 and 11430: 31 of 31 are free, the longest free "
        "stretch has 31. Lower --ports or the label rosproxy.ports (32), widen --port-window "
        "(11400-11430), or stop programs that hold ports there"
    )


def refused(seen: HostState, port: int | None, memory: DockerMemory, now: float) -> DockerPlan:
    return look(seen, memory=memory.with_refusal(PORTS, port, now), now=now)


@pytest.mark.parametrize(
    ("port", "then"), [(11410, PortRange(11411, 11442)), (None, NEXT), (99, NEXT)]
)
def test_a_new_sandbox_that_is_refused_gets_the_next_ports(
    port: int | None, then: PortRange
) -> None:
    seen = observed(container(), sandboxes=[sandbox(state="created", networks=())])
    plan = refused(seen, port, DockerMemory(), 0.0)
    assert plan.actions[:4] == (
        Rename(PORTS, f"{PORTS}-old"),
        new_sandbox(then),
        Remove(f"{PORTS}-old", "replaced by another container"),
        Start(PORTS),
    )
    forgets = replace(plan.memory, planned={})
    assert look(seen, memory=forgets, now=299.0).actions == plan.actions
    assert look(seen, memory=forgets, now=300.0).actions != plan.actions


@pytest.mark.parametrize("port", [11410, None])
def test_ports_that_have_served_are_tried_for_a_while(port: int | None) -> None:
    seen = observed(
        container(), sandboxes=[sandbox(state="exited", networks=())], proxies=[proxy()]
    )
    first = refused(seen, port, DockerMemory(), 100.0)
    assert first.actions[0] == Start(PORTS)
    assert first.again_in == 1.0
    then = refused(seen, port, first.memory, 119.9)
    assert then.actions[0] == Start(PORTS)
    last = refused(seen, port, then.memory, 120.0)
    assert created(last) == (PortRange(11411, 11442) if port else NEXT)
    assert f"has left ports 11400-11431 for {created(last)}" in port_problem(last)
    assert last.memory.moved == {PLACE: Move(RANGE, 120.0)}
    assert last.memory.served == {}


def test_added_ports_that_are_refused_are_given_up() -> None:
    memory = look(observed(container(labels=ASKS_FOR_40), **both())).memory
    longer = sandbox(ports=LONGER, state="created", networks=())
    seen = observed(container(labels=ASKS_FOR_40), sandboxes=[longer])
    for port in (11435, None):
        plan = refused(seen, port, memory, 1.0)
        assert created(plan) == RANGE
        assert "has only the 32 ports" in port_problem(plan)


def test_ports_that_a_stranger_publishes_now_are_left() -> None:
    web = container("web", {}, ports=[11400])
    plan = look(observed(container(), web, sandboxes=[sandbox(state="exited")]))
    assert created(plan) == PortRange(11401, 11432)
    assert "has left ports" in port_problem(plan)


def test_a_start_that_went_well_is_the_end_of_it() -> None:
    memory = DockerMemory().with_refusal(PORTS, None, 0.0)
    plan = look(observed(container(), **both()), memory=memory, now=30.0)
    assert (plan.actions, plan.again_in) == ((), None)
    expected = DockerMemory(served={PLACE: RANGE}, planned={PLACE: RANGE}, names=plan.memory.names)
    assert plan.memory == expected


# all together


def test_problems_of_one_place_do_not_touch_another() -> None:
    arm: Any = both(place=ARM, ports=NEXT)
    alone = look(observed(container("b", ON_ARM), **arm), settings=SETTINGS)
    for bad in (
        container("a", networks=("bridge",)),
        container("a", {**ENABLED, "rosproxy.ports": "1000"}),
        container("a", {**ENABLED, "rosproxy.ports": "none"}),
        container("a", networks=("gone",)),
    ):
        settings = replace(SETTINGS, port_window=PortRange(11400, 11463))
        plan = look(observed(bad, container("b", ON_ARM), **arm), settings=settings)
        assert [group for group in plan.groups if group.place == ARM] == list(alone.groups)


def test_what_lets_names_go_comes_first() -> None:
    """Another proxy may need the name next."""
    seen = observed(
        container(),
        networks=[UPLINK, APP],
        sandboxes=[sandbox(Place(Master("http://zoo:11311"), HERE), ports=NEXT)],
    )
    plan = look(seen)
    assert isinstance(plan.actions[0], Disconnect)
    assert Connect(PORTS, "app", ALIASES) in plan.actions


def test_nothing_is_done_for_a_place_while_one_of_its_containers_is_busy() -> None:
    name = sandbox_name(PLACE)
    idle = look(observed(container(), sandboxes=[sandbox(state="exited")]))
    assert idle.actions
    busy = look(observed(container(), sandboxes=[sandbox(state="exited")], busy={name}))
    assert not busy.actions
    assert not busy.deferred


def test_a_proxy_is_not_made_before_the_address_of_its_master_is_known() -> None:
    plan = look(observed(container(), masters={"robot": ""}))
    assert not any(isinstance(action, Create) for action in plan.actions)
    assert any(isinstance(action, Create) for group in plan.deferred for action in group.actions)
    (problem,) = [p for p in plan.problems if p.subject == "master robot"]
    assert "--add-host robot:ADDRESS" in problem.message
    assert problem.fatal
    other = look(observed(container(), masters={"robot": "192.0.2.7", "arm": ""}))
    assert any(isinstance(action, Create) for action in other.actions)
