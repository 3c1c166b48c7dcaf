"""Topics, services, parameters, actions and the graph, from each place to each other place."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import pytest

from tests.ros.processes import Process, wait_until
from tests.zenoh.lab import PORTS, ROUTER_PORT, VERSIONS, Lab

WAYS = ("redirect", "client")
"""The ways of nodes in containers to the proxy."""
ARRIVE_WITHIN_S = 60.0
USES = (
    "topic",
    "latched",
    "sum 3",
    "get_parameters of use_sim_time",
    "feedback short",
    "status short=executing",
    "status short=succeeded",
    "result succeeded",
    "canceling",
    "status long=executing",
    "status long=canceled",
    "result canceled",
)
"""What a node prints with the name of another node, after the use of all that the node offers."""
TOPICS = ("chatter", "map", "fibonacci/_action/feedback", "fibonacci/_action/status")
CALLED = (
    *("add", "get_parameters"),
    *(f"fibonacci/_action/{name}" for name in ("send_goal", "get_result", "cancel_goal")),
)
SERVICES = (
    *("describe_parameters", "get_parameter_types", "list_parameters"),
    *("set_parameters", "set_parameters_atomically", *CALLED),
)


def everywhere(lab: Lab, version: str, kind: str, topic: str) -> dict[str, Process]:
    """A node in each of two containers, at the robot, and on a laptop."""
    nodes = {role: lab.node(version, role, kind, topic) for role in PORTS}
    nodes["robot"] = lab.node(version, "out", kind, topic)
    nodes["laptop"] = lab.node(version, "out", kind, topic, **lab.as_laptop())
    return nodes


def expected(offers: list[str], users: list[str]) -> Iterator[str]:
    """The lines that each user prints."""
    for offer in offers:
        yield from (f"got {offer} {use}" for use in USES)
        yield from listings(offer, offer, MP=TOPICS, SS=SERVICES)
        for user in users:
            yield from listings(user, offer, MS=TOPICS, SC=CALLED)
    yield from (f"seen {node}" for node in (*offers, *users))


def listings(node: str, owner: str, **entities: tuple[str, ...]) -> Iterator[str]:
    """The lines with which a graph lists the entities of a node."""
    for entity, names in entities.items():
        for name in names:
            yield f"listed {node} {entity} %{owner}%{name.replace('/', '%')}"


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("way", WAYS)
def test_everything_passes(lab: Lab, version: str, way: str) -> None:
    """Each of four places uses what each place offers, and sees all nodes in the graph.

    The users start when the latched messages have been published. Only what the robot uses of its
    own nodes does not pass the proxy.
    """
    lab.start_router(version)
    for role in PORTS if way == "redirect" else ():
        lab.redirect(role)
    lab.start_proxy("--zenoh-listen", str(ROUTER_PORT))
    lab.wait_for_link()
    offers = everywhere(lab, version, "offer", "-")
    for offer in offers.values():
        offer.wait_for("^latched$", timeout=30)
    titles = [offer.title for offer in offers.values()]
    users = everywhere(lab, version, "use", ",".join(titles))
    lines = set(expected(titles, [user.title for user in users.values()]))

    def missing() -> dict[str, list[str]]:
        told = {place: user.output().splitlines() for place, user in users.items()}
        return {place: sorted(gone) for place, seen in told.items() if (gone := lines - {*seen})}

    with suppress(AssertionError):  # the next line tells more
        wait_until("everything arrives", lambda: not missing(), ARRIVE_WITHIN_S)
    assert missing() == {}
    for offer in offers.values():
        offer.kill()
    for user in users.values():
        for title in titles:
            user.wait_for(f"^gone {title}$", timeout=30)


@pytest.mark.parametrize("version", VERSIONS)
def test_containers_with_a_port_each_meet(lab: Lab, version: str) -> None:
    """Nodes stay peers, and the variable names the port."""
    lab.start_proxy(with_robot=False)
    proxy = lab.topology.places["px"].address
    override = {role: f'connect/endpoints=["tcp/{proxy}:{port}"]' for role, port in PORTS.items()}
    subscriber = lab.node(version, "c1", "sub", ZENOH_CONFIG_OVERRIDE=override["c1"])
    lab.node(version, "c2", "pub", ZENOH_CONFIG_OVERRIDE=override["c2"])
    subscriber.wait_for_count("^got hello ", 5, timeout=30)
