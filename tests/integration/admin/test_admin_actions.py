"""Changes at the admin endpoint: allowed callers, refusals, and updates of an operator."""

import asyncio
import json

import pytest

from examples.demo.fake_http import End, free_ports
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode
from rosproxy.ros1.clients.node_client import ProbeAnswer
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.setting_kinds import hash_token
from tests.integration.admin_calls import post, tell, update
from tests.integration.commands import admin_url, run
from tests.integration.conftest import MakeNode, MakeProxy
from tests.integration.net import (
    NODE,
    OTHER_NODE,
    OUTSIDE,
    THIRD_NODE,
    connect,
    exchange,
    greet,
    read_header,
    refuses,
    service_header,
    topic_header,
    until,
)
from tests.integration.proxy import Proxy

TOKEN = "0123456789abcdef"
PATIENT = {"cleanup_after": 0.0, "linger": 60.0}
"""The proxy unregisters no node and frees no port, unless a test asks for that."""


@pytest.fixture
def from_afar(monkeypatch: pytest.MonkeyPatch) -> None:
    """Count no caller as local, although all callers in these tests are on loopback."""
    monkeypatch.setattr("rosproxy.admin.admin_server.is_loopback", lambda _: False)


PATHS = ["/probe", "/containers", "/master-address", "/retire", "/policy", "/page-key"]


@pytest.mark.usefixtures("from_afar")
@pytest.mark.parametrize("path", PATHS)
async def test_who_is_not_on_loopback_needs_the_token(make_proxy: MakeProxy, path: str) -> None:
    proxy = await make_proxy(admin_token=TOKEN)
    for headers in (
        [],
        ["Authorization: Bearer wrong-token"],
        [f"Authorization: Basic {TOKEN}"],
        [f"Authorization: bearer{TOKEN}"],
        [f"Authorization: Bearer {TOKEN}x"],
        ["Authorization: Bearer \xfc\xfc\xfc\xfc\xfc\xfc\xfc\xfc"],
        [f"X-Token: {TOKEN}"],
    ):
        reply = await post(proxy, path, "{}", *headers)
        assert reply.status == 403
        assert b"ROSPROXY_ADMIN_TOKEN" in reply.body
    assert not proxy.ros1.context.retired
    right = await post(proxy, path, '{"x": 1}', f"Authorization: Bearer {TOKEN}")
    assert right.status in (200, 400)


@pytest.mark.usefixtures("from_afar")
async def test_a_proxy_that_has_the_hash_alone_lets_in_who_has_the_token(
    make_proxy: MakeProxy,
) -> None:
    proxy = await make_proxy(admin_token_hash=hash_token(TOKEN))
    for said in ("wrong-token", hash_token(TOKEN), ""):
        reply = await post(proxy, "/retire", "{}", f"Authorization: Bearer {said}")
        assert reply.status == 403
        assert b"this proxy has no token" not in reply.body
    assert (await post(proxy, "/retire", "{}", f"Authorization: Bearer {TOKEN}")).status == 200


@pytest.mark.usefixtures("from_afar")
async def test_without_a_token_nobody_from_afar_may(proxy: Proxy) -> None:
    for headers in ([], ["Authorization: Bearer None"], ["Authorization: Bearer "]):
        reply = await post(proxy, "/retire", "", *headers)
        assert reply.status == 403
        assert b"this proxy has no token" in reply.body


@pytest.mark.usefixtures("from_afar")
async def test_everybody_may_look(make_proxy: MakeProxy) -> None:
    proxy = await make_proxy(admin_token=TOKEN)
    address = (proxy.settings.admin.host, proxy.settings.admin.port)
    for path in ("/healthz", "/metrics", "/status"):
        reply = await exchange(address, f"GET {path} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        assert reply.status == 200
        assert TOKEN.encode() not in reply.body


async def test_a_page_in_a_browser_on_this_host_may_not(proxy: Proxy) -> None:
    reply = await post(proxy, "/retire", "{}", "Origin: http://evil.example")
    assert reply.status == 403
    assert not proxy.ros1.context.retired


@pytest.mark.usefixtures("from_afar")
async def test_commands_send_the_token(make_proxy: MakeProxy, node: FakeNode) -> None:
    proxy = await make_proxy(admin_token=TOKEN)
    await node.publish(proxy.master)
    words = ("doctor", "--admin", admin_url(proxy), "--json")
    without = await run(*words)
    assert "HTTP 403" in without.out
    assert "HTTP 403" not in (await run(*words, ROSPROXY_ADMIN_TOKEN=TOKEN)).out


def test_the_token_does_not_show() -> None:
    from tests.integration.proxy import settings_for

    settings = settings_for(master_uri="http://robot:11311", admin_token=TOKEN)
    assert settings.admin_token == TOKEN
    assert TOKEN not in repr(settings)


BAD = [
    ("/containers", "nonsense", "the body: must be JSON"),
    ("/containers", "[" * 100_000, "the body: must be JSON"),
    ("/containers", "1" * 10_000, "the body: must be JSON"),
    ("/containers", "[]", "the body: Expected `object`, got `array`"),
    ("/containers", '{"gone": ["x"]}', "gone[0]: must be an IP address"),
    ("/containers", '{"moved": {"a": "b"}}', "moved: must be an IP address"),
    (
        "/containers",
        '{"arrived": [{"names": []}]}',
        "arrived[0]: Object missing",
    ),
    ("/containers", '{"gone": [], "left": []}', "the body: Object contains unknown field `left`"),
    ("/retire", '{"x": 1}', "the body: Object contains unknown field `x`; known: none"),
]


@pytest.mark.parametrize(("path", "body", "complaint"), BAD)
async def test_a_bad_body_is_told_apart(proxy: Proxy, path: str, body: str, complaint: str) -> None:
    reply = await post(proxy, path, body)
    assert reply.status == 400
    assert reply.body.decode().startswith(f"rosproxy: {complaint}")
    assert not proxy.ros1.context.retired


async def test_a_body_in_no_encoding(proxy: Proxy) -> None:
    assert (await post(proxy, "/containers", b'{"gone": ["\xff\xfe"]}')).status == 400


async def test_a_body_that_is_too_long(proxy: Proxy) -> None:
    assert (await post(proxy, "/containers", b" " * (1024 * 1024 + 1))).status == 413
    assert (await post(proxy, "/containers", b" " * (1024 * 1024))).status == 200


async def test_no_update(proxy: Proxy) -> None:
    assert await update(proxy) == (0, 0, 0)
    assert await update(proxy, gone=[NODE], moved={NODE: OTHER_NODE}) == (0, 0, 0)
    assert await update(proxy, arrived=[{"address": NODE, "names": ["c1"]}]) == (0, 0, 0)


async def populate(proxy: Proxy, node: FakeNode) -> None:
    """Make a registration of each kind."""
    await node.publish(proxy.master)
    await node.publish(proxy.master, "/rosout")
    await node.subscribe(proxy.master, "/back")
    await node.serve(proxy.master)
    await node.call(proxy.master, "subscribeParam", node.uri, "/rate")


def everything(master: FakeMaster) -> list[str]:
    """All names that the master knows of."""
    return [key for table in master.tables.values() for key in table]


async def test_a_container_that_is_gone(
    make_proxy: MakeProxy, make_node: MakeNode, master: FakeMaster
) -> None:
    proxy = await make_proxy(**PATIENT)
    dead = await make_node()
    alive = await make_node("/alive", OTHER_NODE)
    await populate(proxy, dead)
    await alive.publish(proxy.master, "/update")
    lease = proxy.lease(dead)
    await dead.stop()
    assert await update(proxy, gone=[NODE, OTHER_NODE, THIRD_NODE]) == (1, 0, 0)
    assert everything(master) == ["/update"]
    assert await refuses(lease)
    assert await update(proxy, gone=[NODE]) == (0, 0, 0)
    assert await greet(proxy.lease(alive), topic_header("/update"))


@pytest.mark.parametrize("was_unregistered", [False, True])
async def test_a_node_whose_container_is_gone_is_no_fault(
    was_unregistered: bool, make_proxy: MakeProxy, node: FakeNode
) -> None:
    """Also a node that hung for so long that the proxy has unregistered the node."""
    hasty = {"cleanup_after": 0.05, "probe_interval": 0.05, "probe_timeout": 0.05, "linger": 60.0}
    proxy = await make_proxy(**(hasty if was_unregistered else PATIENT))
    await node.publish(proxy.master)
    endpoint = proxy.endpoint(node)
    node.hang = True
    if was_unregistered:
        await until(lambda: endpoint.state == "cleaned", "the proxy unregisters it")
    else:
        await node.stop()
    await until(lambda: proxy.metric("nodes_down", node=node.name), "the node counts as down")
    await update(proxy, gone=[NODE])
    await until(lambda: endpoint.state == "ended", "the node counts as ended")
    assert not proxy.metric("nodes_down", node=node.name)


async def test_a_node_that_hangs_is_not_waited_for(
    make_proxy: MakeProxy, node: FakeNode, master: FakeMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "rosproxy.ros1.upkeep.containers.YOUNG_NODE_AGE_S", -1.0
    )  # the node is not young
    proxy = await make_proxy(**PATIENT, probe_timeout=10.0)
    await node.publish(proxy.master)
    node.hang = True
    before = proxy.ros1.context.now()
    assert await update(proxy, gone=[NODE]) == (1, 0, 0)
    assert proxy.ros1.context.now() - before < 9  # less than the time limit of a probe
    assert not everything(master)
    node.hang = False  # the update was wrong
    await until(lambda: master.holds("publishers", "/chatter"), "the node is registered again")


async def test_a_node_that_has_just_registered_may_take_its_time(
    make_proxy: MakeProxy, node: FakeNode, master: FakeMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A restarted container has its address again before the update that it was gone."""
    monkeypatch.setattr("rosproxy.ros1.upkeep.containers.SECOND_PROBE_DELAY_S", 0.6)
    proxy = await make_proxy(**PATIENT)
    await node.publish(proxy.master)
    node.hang = True
    assert await update(proxy, gone=[NODE]) == (0, 0, 0)
    assert not await refuses(proxy.lease(node))
    assert everything(master)
    await until(lambda: not everything(master), "the second chance is over")


async def test_its_open_connections_end(make_proxy: MakeProxy, node: FakeNode) -> None:
    proxy = await make_proxy(**PATIENT)
    await node.publish(proxy.master)
    async with connect(proxy.lease(node)) as wire:
        await wire.send(topic_header())
        await read_header(wire)
        await node.slave.stop()
        assert await update(proxy, gone=[NODE]) == (1, 0, 0)
        assert await wire.end() == "closed"


async def test_a_port_that_a_living_node_got_meanwhile_keeps_its_connections(
    make_proxy: MakeProxy, make_node: MakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """During the probe of a dead node, the only port of the range goes to another node."""
    port = free_ports(1)
    proxy = await make_proxy(port_range=f"{port}-{port}", probe_interval=0.05, linger=60.0)
    dead = await make_node()
    alive = await make_node("/alive", OTHER_NODE)
    await dead.publish(proxy.master)
    await dead.stop()
    await until(lambda: proxy.endpoint(dead).health.down, "the proxy knows that it is dead")
    asked = asyncio.Event()
    answered = asyncio.Event()
    probe = proxy.ros1.context.nodes.probe

    async def slow_probe(slave: HostPort, *timeout: float) -> ProbeAnswer:
        if timeout:  # a probe because of the operator's update
            asked.set()
            await answered.wait()
        return await probe(slave, *timeout)

    monkeypatch.setattr(proxy.ros1.context.nodes, "probe", slow_probe)
    told = asyncio.create_task(update(proxy, gone=[NODE]))
    await asked.wait()
    await alive.publish(proxy.master, "/update")
    assert proxy.lease(alive)[1] == port
    async with connect(proxy.lease(alive)) as wire:
        await wire.send(topic_header("/update"))
        await read_header(wire)
        answered.set()
        await told
        assert await greet(proxy.lease(alive), topic_header("/update"))
        assert not wire.reader.at_eof()


async def test_another_process_at_an_address_that_is_gone(
    make_proxy: MakeProxy, node: FakeNode, master: FakeMaster
) -> None:
    """The process answers, but has none of the former node's topics."""
    proxy = await make_proxy(**PATIENT, probe_interval=60.0)
    await node.publish(proxy.master)
    await until(lambda: proxy.endpoint(node).health.pid, "the node is probed")
    node.pid += 1
    node.published.clear()
    assert await update(proxy, gone=[NODE]) == (0, 0, 0)
    await until(lambda: not everything(master), "the former registrations are removed")


async def test_a_port_is_given_up_after_linger_though_the_address_is_silent(
    make_proxy: MakeProxy, node: FakeNode
) -> None:
    proxy = await make_proxy(cleanup_after=0.0, linger=0.2)
    await node.publish(proxy.master)
    node.hang = True
    await update(proxy, gone=[NODE])
    await until(lambda: not len(proxy.ros1.context.registry), "the port is free again")


async def test_a_master_that_is_away_gets_the_unregistrations_later(
    make_proxy: MakeProxy, node: FakeNode, master: FakeMaster
) -> None:
    proxy = await make_proxy(linger=60.0, cleanup_after=60.0)
    await node.publish(proxy.master)
    lease = proxy.lease(node)
    await node.stop()
    await master.stop()
    reply = await post(proxy, "/containers", json.dumps({"gone": [NODE]}))
    assert reply.status == 503
    assert reply.body.endswith(b"try again\n")
    assert await refuses(lease)
    await master.start()
    await until(lambda: not everything(master), "the proxy unregisters the node")
    assert await update(proxy, gone=[NODE]) == (0, 0, 0)


class Container:
    """A node in a container that can get another address."""

    def __init__(self, node: FakeNode, proxy: Proxy) -> None:
        self.node = node
        self.proxy = proxy
        self.uri = node.uri

    async def move(self, address: str) -> None:
        """Move the process to another address, with the same URI."""
        await self.node.stop()
        self.node.host = self.node.host
        self.node.address = address
        await self.node.start()
        assert self.node.uri == self.uri

    @property
    def endpoint(self) -> Endpoint:
        return self.proxy.endpoint(self.node)


@pytest.fixture
async def container(make_proxy: MakeProxy, make_node: MakeNode) -> Container:
    """A node with a registration of each kind. The proxy knows the pid."""
    node = await make_node(port=free_ports(1))
    proxy = await make_proxy(**PATIENT, probe_interval=60.0)
    await populate(proxy, node)
    moved = Container(node, proxy)
    await until(lambda: moved.endpoint.health.pid, "the node is probed")
    return moved


async def test_a_container_that_has_moved(
    container: Container, master: FakeMaster, make_node: MakeNode
) -> None:
    proxy = container.proxy
    node = container.node
    robot = await make_node("/robot", OUTSIDE)
    await robot.subscribe(master.uri)
    lease = proxy.lease(node)
    uri = proxy.uri(node)
    await container.move(OTHER_NODE)
    assert await update(proxy, moved={NODE: OTHER_NODE}) == (0, 1, 0)
    assert (proxy.lease(node), proxy.uri(node)) == (lease, uri)
    for kind, name in [("publishers", "/chatter"), ("subscribers", "/back"), ("params", "/rate")]:
        assert master.holds(kind, name) == [uri]
    # rospy and roscpp connect to a URI again only if it was gone meanwhile.
    await until(lambda: robot.updates()[-2:] == [[], [uri]], "outside subscribers connect anew")
    assert master.holds("services", "/add") == [f"rosrpc://{lease[0]}:{lease[1]}"]
    assert (await greet(lease, topic_header()))["callerid"] == "/talker"
    assert (await greet(lease, service_header()))["callerid"] == "/talker"
    assert not [call for call in node.calls if call[0] == "shutdown"]
    assert await update(proxy, moved={NODE: OTHER_NODE}) == (0, 0, 0)


async def test_it_goes_on_calling_itself_what_it_did(
    container: Container, master: FakeMaster, make_node: MakeNode
) -> None:
    proxy = container.proxy
    node = container.node
    await container.move(OTHER_NODE)
    await update(proxy, moved={NODE: OTHER_NODE})
    await node.publish(proxy.master, "/more")
    assert master.holds("publishers", "/more") == [proxy.uri(node)]
    assert len(proxy.ros1.context.registry) == 1
    await node.call(proxy.master, "unregisterPublisher", "/chatter", node.uri)
    assert not master.holds("publishers", "/chatter")
    neighbour = await make_node("/neighbour", THIRD_NODE)
    uris = (await neighbour.subscribe(proxy.master, "/more"))[2]
    assert uris != [node.uri]
    assert f":{proxy.lease(node)[1]}/" in uris[0]


async def test_its_subscriptions_are_told_to_connect_again(container: Container) -> None:
    await container.move(OTHER_NODE)
    await update(container.proxy, moved={NODE: OTHER_NODE})
    assert container.node.updates("/back")[:2] == [[], []]


async def test_another_process_at_the_new_address_is_not_the_same(
    container: Container, master: FakeMaster
) -> None:
    before = container.proxy.uri(container.node)
    await container.move(OTHER_NODE)
    container.node.pid += 1
    assert await update(container.proxy, moved={NODE: OTHER_NODE}) == (0, 0, 0)
    assert master.holds("publishers", "/chatter") == [before]


async def test_a_new_address_outside_of_all_inside_networks(container: Container) -> None:
    await container.move(OUTSIDE)
    assert await update(container.proxy, moved={NODE: OUTSIDE}) == (0, 0, 0)


async def test_a_moved_container_that_has_already_registered_at_its_new_address(
    container: Container, master: FakeMaster
) -> None:
    """The node has another port under the same name. All topics are registered there."""
    proxy = container.proxy
    node = container.node
    await container.move(OTHER_NODE)
    await node.publish(proxy.master, "/more")
    assert master.holds("publishers", "/chatter") == []
    assert await update(proxy, moved={NODE: OTHER_NODE}) == (0, 0, 0)
    uri = proxy.uri(node)
    for name in ("/more", "/chatter", "/rosout"):
        assert master.holds("publishers", name) == [uri]
    assert master.holds("subscribers", "/back") == [uri]


async def test_a_master_that_is_away_gets_the_move_later(
    container: Container, master: FakeMaster
) -> None:
    proxy = container.proxy
    node = container.node
    await container.move(OTHER_NODE)
    await master.stop()
    reply = await post(proxy, "/containers", json.dumps({"moved": {NODE: OTHER_NODE}}))
    assert reply.status == 503
    await master.start()
    await until(lambda: not container.endpoint.unsettled, "the endpoint is settled")
    assert master.holds("publishers", "/chatter") == [proxy.uri(node)]


async def test_a_container_that_is_back_elsewhere(container: Container, master: FakeMaster) -> None:
    """First gone, like a container that leaves its network, then back at another address."""
    proxy = container.proxy
    node = container.node
    await node.stop()
    assert await update(proxy, gone=[NODE]) == (1, 0, 0)
    assert not everything(master)
    await container.move(OTHER_NODE)
    assert await update(proxy, moved={NODE: OTHER_NODE}) == (0, 1, 0)
    assert master.holds("publishers", "/chatter") == [proxy.uri(node)]
    assert master.holds("services", "/add")


async def test_retiring(
    make_proxy: MakeProxy, node: FakeNode, make_node: MakeNode, master: FakeMaster
) -> None:
    proxy = await make_proxy(**PATIENT)
    await populate(proxy, node)
    lease = proxy.lease(node)
    assert await tell(proxy, "/retire") == {"unregistered": 1}
    assert not everything(master)
    assert await refuses(lease)
    late = await make_node("/late")
    for registering in (late.publish(proxy.master), node.publish(proxy.master, "/more")):
        # Nodes try again, and register at the next proxy. An answer with an error would be final.
        with pytest.raises(ConnectionResetError):
            await registering
    assert await tell(proxy, "/retire") == {"unregistered": 0}
    await proxy.ros1.master_monitor.look()
    await proxy.ros1.registrar.register_lost()
    await proxy.ros1.prober.look()
    assert not everything(master)
    address = (proxy.settings.admin.host, proxy.settings.admin.port)
    ready = await exchange(address, b"GET /readyz HTTP/1.1\r\nHost: x\r\n\r\n")
    assert (ready.status, ready.body) == (
        503,
        b"the proxy is retired and accepts no registrations\n",
    )


async def test_retiring_waits_for_registrations_under_way(
    make_proxy: MakeProxy, node: FakeNode, master: FakeMaster
) -> None:
    import asyncio

    proxy = await make_proxy(**PATIENT)
    await until(lambda: proxy.ros1.master_monitor.up, "the master is seen")
    master.delay = 0.3
    registering = asyncio.create_task(node.publish(proxy.master))
    await until(lambda: len(proxy.ros1.context.registry), "the node is admitted")
    await tell(proxy, "/retire")
    await registering
    assert not everything(master)


async def test_a_proxy_that_can_not_retire_yet(
    make_proxy: MakeProxy, node: FakeNode, master: FakeMaster
) -> None:
    proxy = await make_proxy(**PATIENT)
    await node.publish(proxy.master)
    master.answers["system.multicall"] = End.RESET
    assert (await post(proxy, "/retire")).status == 503
    with pytest.raises(ConnectionResetError):
        await node.publish(proxy.master, "/more")
    del master.answers["system.multicall"]
    assert await tell(proxy, "/retire") == {"unregistered": 1}
    assert not everything(master)
