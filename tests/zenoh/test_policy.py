"""The policy: denied topics and services stop at the container, in both directions."""

from __future__ import annotations

import os

import pytest

from tests.ros.processes import Process, wait_until
from tests.zenoh.lab import PORTS, VERSIONS, Lab

VERSION = "1.6.2"
RULES = (
    "deny publish /p/denied; deny subscribe /s/denied; deny serve /f/denied; deny call /c/denied"
)
LISTS = (
    "deny publish /p/denied; allow publish /p/*; deny publish *; deny publish /never; "
    "allow subscribe /s/allowed; deny subscribe *; allow serve */allowed; deny serve *; "
    "allow call /c/al*; deny call *"
)
"""The same for these names, as lists of what is allowed."""
ENDS = ("denied", "allowed")
BACK_WITHIN_S = 15.0


def started(lab: Lab, version: str, *options: str) -> None:
    """The robot's router, redirects, and the proxy."""
    lab.start_router(version)
    for role in PORTS:
        lab.redirect(role)
    lab.start_proxy(*options)
    lab.wait_for_link()


class Pair:
    """A node that sends or asks, a node that receives or serves, and the topic or service."""

    def __init__(self, lab: Lab, version: str, source: str, target: str, topic: str) -> None:
        asks = topic[0] in "fc"
        self.topic = topic
        self.target = lab.node(version, target, "serve" if asks else "sub", topic)
        self.source = lab.node(version, source, "call" if asks else "pub", topic)
        self.receiver = self.source if asks else self.target
        self.line = "^answer of " if asks else "^got hello "

    def wait(self, timeout: float = 30.0) -> None:
        """Wait until messages or answers arrive, from now on."""
        self.receiver.wait_for_count(self.line, 3, timeout, since=self.receiver.mark())

    @property
    def has_received(self) -> bool:
        """Whether a message or an answer has ever arrived."""
        return self.line.removeprefix("^") in self.receiver.output()


def listed(graph: Process, node: Process) -> bool:
    """Whether the topic or service of a node has appeared in a graph."""
    return f"\nlisted {node.title} " in graph.output()


@pytest.mark.parametrize(
    ("version", "far", "rules"),
    [
        *((version, "out", rules) for version in VERSIONS for rules in (RULES, LISTS)),
        (VERSION, "c2", RULES),
    ],
    ids=lambda value: {RULES: "denials", LISTS: "lists"}.get(value, value),
)
def test_denied_names_stop_at_the_container(lab: Lab, version: str, far: str, rules: str) -> None:
    started(lab, version, "--policy", rules)
    graphs = {role: lab.node(version, role, "graph") for role in ("c1", far)}
    for graph in graphs.values():
        graph.wait_for("^ready")
    ways = {"p": ("c1", far), "s": (far, "c1"), "f": (far, "c1"), "c": ("c1", far)}
    pairs = {
        (kind, end): Pair(lab, version, *way, f"{kind}/{end}")
        for end in ENDS
        for kind, way in ways.items()
    }
    for (_, end), pair in pairs.items():
        if end == "allowed":
            pair.wait()
    for (kind, end), pair in pairs.items():
        assert pair.has_received == (end == "allowed"), (kind, end)
        source, target = ways[kind]
        for graph, node in ((graphs[target], pair.source), (graphs[source], pair.target)):
            graph.wait_for(f"^seen {node.title}$", timeout=30)
            if end == "allowed":
                wait_until("it is listed", lambda g=graph, n=node: listed(g, n), 30)
            else:
                assert not listed(graph, node), (kind, graph.output())
    # Within the container, nothing is denied.
    Pair(lab, version, "c1", "c1", "p/denied").wait()
    hidden = {("publish", "/p/denied"), ("subscribe", "/s/denied")}
    hidden |= {("serve", "/f/denied"), ("call", "/c/denied")}
    hidden |= {("subscribe", "/p/denied")} if rules == LISTS else set()
    wait_until("denied names are told", lambda: hidden_names(lab) == hidden, 30)


def hidden_names(lab: Lab) -> set[tuple[str, str]]:
    """The names that the policy hides, as the status tells, with the kinds of rules."""
    policy = lab.status().policy
    return {(name.kind, name.name) for name in policy.hidden} if policy else set()


@pytest.mark.parametrize("version", VERSIONS)
def test_latched_messages_obey_the_policy(lab: Lab, version: str) -> None:
    started(lab, version, "--policy", "deny publish /p/denied")
    for end in ("denied", "allowed"):
        lab.node(version, "c1", "latch", f"p/{end}").wait_for("^latched$")
    late = {end: lab.node(version, "out", "late", f"p/{end}") for end in ("denied", "allowed")}
    late["allowed"].wait_for("^got latched$", timeout=30)
    lab.node(version, "c1", "latch", "p/denied").wait_for("^latched$")
    lab.node(version, "out", "late", "p/allowed").wait_for("^got latched$", timeout=30)
    assert "got" not in late["denied"].output()


@pytest.mark.parametrize("version", VERSIONS)
def test_lists_stop_keys_with_wildcards(lab: Lab, version: str) -> None:
    """Nodes use no such keys. A session of zenoh may, to reach names that it does not know."""
    started(lab, version, "--policy", LISTS)
    served = Pair(lab, version, "out", "c1", "f/allowed")
    private = lab.node(version, "c1", "serve", "f/denied")
    heard = Pair(lab, version, "out", "c1", "s/allowed")
    silent = lab.node(version, "c1", "sub", "s/denied")
    served.wait()
    heard.wait()
    probe = lab.node(version, "out", "probe", "**")
    shout = lab.node(version, "out", "shout", "**")
    shout.wait_for("^said$", timeout=30)
    probe.wait_for_count("^asked$", 2, timeout=30)
    heard.wait()
    assert "answer" not in probe.output(), private.title
    assert "got" not in silent.output()


def numbers(node: Process) -> list[int]:
    """The numbers of the messages that a subscriber has received."""
    return [int(line.split()[-1]) for line in node.output().splitlines() if "got hello" in line]


def layer_of(lab: Lab, role: str, rule: str) -> dict[str, object]:
    """A layer for a container, as the operator for Docker gives it."""
    address = lab.topology.places[role].address
    return {"name": role, "rules": [rule], "addresses": [address], "ports": [PORTS[role]]}


class Watcher:
    """A node that watches the graph in one place, and a node of another place."""

    def __init__(self, lab: Lab, version: str, role: str, node: Process) -> None:
        self.graph = lab.node(version, role, "graph")
        self.node = node
        self._mark = 0
        self.graph.wait_for(f"^listed {node.title} ", timeout=30)

    def note(self) -> None:
        """Note the start of a change, for `wait_for_return`."""
        self._mark = self.graph.mark()

    def wait_for_return(self, *, is_denied: bool) -> None:
        """Wait until the node has left the graph, and is there again with its topic or without."""
        self.graph.wait_for(f"^gone {self.node.title}$", BACK_WITHIN_S, since=self._mark)
        wait_until("the node is back", lambda: self._last("seen", "gone") == "seen", BACK_WITHIN_S)
        word = "unlisted" if is_denied else "listed"
        wait_until(
            f"the topic is {word}",
            lambda: self._last("listed", "unlisted") == word,
            BACK_WITHIN_S,
        )

    def _last(self, *words: str) -> str:
        """The word of the last change of the node, of some words for changes."""
        changes = [line.split() for line in self.graph.output().splitlines()]
        own = [change[0] for change in changes if self.node.title in change]
        return next(word for word in reversed(own) if word in words)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_change_of_rules_concerns_one_container(lab: Lab, version: str) -> None:
    """With routers of zenoh 1.9 or later, the graph remains empty after a router has reopened."""
    started(lab, version, "--zenoh-listen", "7447")
    concerned = Pair(lab, version, "c1", "out", "p/one")
    other = Pair(lab, version, "c2", "out", "p/other")
    for pair in (concerned, other):
        pair.wait()
    watchers = [
        Watcher(lab, version, "out", concerned.source),
        Watcher(lab, version, "c1", concerned.target),
    ]
    hidden = {("publish", "/p/one")}
    for layers in ([layer_of(lab, "c1", "deny publish /p/one")], []):
        for watcher in watchers:
            watcher.note()
        lab.post_policy(*layers)
        closed = concerned.receiver.mark()
        other.wait()
        for watcher in watchers:
            watcher.wait_for_return(is_denied=bool(layers))
        if layers:
            Pair(lab, version, "c1", "out", "p/more").wait(BACK_WITHIN_S)
            assert "got" not in concerned.receiver.output()[closed:]
            wait_until("the denied name is told", lambda: hidden_names(lab) == hidden, 30)
    Watcher(lab, version, "out", concerned.source)
    Watcher(lab, version, "c1", concerned.target)
    concerned.wait(BACK_WITHIN_S)
    other.wait()
    told = numbers(other.receiver)
    assert told == [*range(told[0], told[-1] + 1)], "the other container has lost messages"
    assert lab.zenoh().restarts == 0
    # No node inside has found the port of the hub.
    at_hub = {s.remote.rpartition(":")[0] for s in lab.zenoh().sessions if s.port is None}
    assert at_hub == {lab.topology.plan.robot}


@pytest.mark.parametrize("version", VERSIONS)
def test_the_rules_hold_for_laptops(lab: Lab, version: str) -> None:
    """A laptop gets no denied name of the robot either, since both are outside."""
    rules = "deny publish /p/denied; deny subscribe /s/denied; deny serve /f/denied"
    started(lab, version, "--zenoh-listen", "7447", "--policy", rules)
    laptop = lab.as_laptop()
    heard = {}
    for source in ("c1", "out"):
        for end in ("denied", "allowed"):
            topic = f"p/{end}/{source}" if end == "allowed" else "p/denied"
            heard[source, end] = lab.node(version, "out", "sub", topic, **laptop)
            lab.node(version, source, "pub", topic)
    calls = {end: lab.node(version, "out", "call", f"f/{end}", **laptop) for end in ENDS}
    taken = {end: lab.node(version, "c1", "sub", f"s/{end}") for end in ENDS}
    for end in ENDS:
        lab.node(version, "c1", "serve", f"f/{end}")
        lab.node(version, "out", "pub", f"s/{end}", **laptop)
    for source in ("c1", "out"):
        heard[source, "allowed"].wait_for_count("^got hello ", 3, 30)
    calls["allowed"].wait_for_count("^answer of ", 3, 30)
    taken["allowed"].wait_for_count("^got hello ", 3, 30)
    silent = [*(heard[source, "denied"] for source in ("c1", "out")), calls["denied"]]
    for node in (*silent, taken["denied"]):
        assert "hello" not in node.output()
        assert "answer" not in node.output()


def test_the_policy_outlives_routers_and_proxy(lab: Lab) -> None:
    options = ("--policy", "deny publish /p/denied")
    started(lab, VERSION, *options)
    denied = Pair(lab, VERSION, "c1", "out", "p/denied")
    allowed = Pair(lab, VERSION, "c1", "out", "p/allowed")
    allowed.wait()
    os.kill(lab.router_process(), 9)
    allowed.wait(BACK_WITHIN_S)
    lab.restart_proxy(*options)
    allowed.wait(BACK_WITHIN_S)
    allowed.wait()
    assert not denied.has_received


def test_the_rules_follow_a_container_to_another_port(lab: Lab) -> None:
    """A program in a container may use the port of another container."""
    started(lab, VERSION)
    other = Pair(lab, VERSION, "c2", "out", "p/denied")
    lab.post_policy(layer_of(lab, "c1", "deny publish /p/denied"))
    other.wait()
    assert lab.proxy is not None
    own = lab.as_client(PORTS["c2"])
    lab.node(VERSION, "c1", "pub", "p/denied", **own)
    lab.proxy.wait_for(f"zenoh policy changed: ports {PORTS['c2']}", timeout=30)
    lab.node(VERSION, "c1", "pub", "p/allowed", **own)
    subscriber = lab.node(VERSION, "out", "sub", "p/allowed")
    late = lab.node(VERSION, "out", "sub", "p/denied")
    subscriber.wait_for_count("^got ", 3, BACK_WITHIN_S)
    assert "got" not in late.output()


def test_a_peer_that_is_the_proxy_itself_opens_no_way_past_the_rules(lab: Lab) -> None:
    """In about half of the runs, the hub came to the container's router as a node."""
    port = PORTS["c1"]
    addresses = ("127.0.0.1", lab.topology.places["px"].address)
    peers = [word for address in addresses for word in ("--zenoh-peer", f"{address}:{port}")]
    lab.start_proxy(*peers, "--policy", RULES, with_robot=False)
    for role in PORTS:
        lab.redirect(role)
    allowed, denied = (Pair(lab, VERSION, "c1", "c2", f"p/{end}") for end in reversed(ENDS))
    allowed.wait()
    faults = {f"{address}:{port}": "the proxy itself" for address in addresses}
    wait_until("the fault is told", lambda: {k.peer: k.error for k in lab.zenoh().links} == faults)
    denied.source.wait_for("^said")
    allowed.wait()
    assert not denied.has_received
