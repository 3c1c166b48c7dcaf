"""Attacks by forged replies, registrations and entries at the master."""

from collections.abc import AsyncIterator
from xmlrpc.client import Fault

import pytest

from examples.demo.fake_http import Answer, FakeHttpServer, FakeRequest, call, ok, value
from tests.integration.net import (
    HOST,
    NODE,
    OTHER_NODE,
    PROXY,
    connect,
    greet,
    knock,
    post,
    refuses,
    rpc,
    service_header,
    topic_header,
    until,
    xml,
)

SECRET = b"<html>the other host's secret</html>"


class Victim:
    """An ordinary service of an inside host, which outside must not reach."""

    def __init__(self) -> None:
        self.answer: Answer = ok(SECRET)
        self.seen: list[FakeRequest] = []
        self.http = FakeHttpServer(self._respond)

    @property
    def port(self) -> int:
        return self.http.address[1]

    async def _respond(self, request: FakeRequest) -> Answer:
        self.seen.append(request)
        return self.answer


@pytest.fixture
async def victim() -> AsyncIterator[Victim]:
    made = Victim()
    await made.http.start(OTHER_NODE)
    yield made
    await made.http.stop()


@pytest.fixture
def _as_if_not_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests' addresses are loopback, where a node's word counts for even less."""
    monkeypatch.setattr("rosproxy.ros1.servers.admission.is_loopback", lambda address: False)


async def test_a_forged_request_topic_reply_leads_nowhere_else(proxy, node, victim):
    await node.publish(proxy.master)
    forged = [1, "ready", ["TCPROS", OTHER_NODE, victim.port]]
    node.answers["requestTopic"] = value(forged)
    asked = await rpc(proxy.uri(node), "requestTopic", "/outside", "/chatter", [["TCPROS"]])
    assert asked[2] == ["TCPROS", *proxy.lease(node)]
    async with connect(proxy.lease(node)) as wire:
        await wire.send(topic_header())
        assert await wire.end() == "reset"
    assert victim.http.connections == 0


async def test_a_forged_service_address_leads_nowhere_else(proxy, node, victim):
    for host in (OTHER_NODE, "localhost", "127.0.0.1"):
        forged = f"rosrpc://{host}:{victim.port}"
        await node.call(proxy.master, "registerService", "/add", forged, node.uri)
        assert await knock(proxy.lease(node), service_header()) in ("reset", "answered")
    assert victim.http.connections == 0


@pytest.mark.usefixtures("_as_if_not_loopback")
@pytest.mark.parametrize(
    "answer",
    [
        ok(SECRET),
        value(5),
        value([1, "", "x"]),
        value([0, "", 5]),
        value([1, "", 5])[:-30],
        b"HTTP/1.1 302 Found\r\nLocation: /\r\nContent-Length: 0\r\n\r\n",
    ],
    ids=["web page", "number", "no pid", "failure", "cut", "redirect"],
)
async def test_a_forged_caller_api_does_not_open_a_door_to_an_ordinary_service(
    proxy, node, victim, answer
):
    victim.answer = answer
    uri = f"http://{OTHER_NODE}:{victim.port}/"
    await node.call(proxy.master, "registerPublisher", "/t", "x/Y", uri)
    (endpoint,) = proxy.ros1.context.registry
    assert endpoint.location.address == NODE
    probes = len(victim.seen)
    lease = HOST, endpoint.port
    for data in (post(xml("getBusStats", "/outside")), topic_header("/t")):
        assert await knock(lease, data) in ("refused", "reset", "closed")
    assert len(victim.seen) == probes


@pytest.mark.usefixtures("_as_if_not_loopback")
async def test_a_foreign_registration_opens_no_further_port_of_a_node(proxy, make_node, victim):
    evil = await make_node("/evil")
    other = await make_node("/other", OTHER_NODE)
    forged = f"rosrpc://{OTHER_NODE}:{victim.port}"
    door = "registerService", "/door", forged, other.uri
    # In the node's name: first as the only registration, then beside the node's own.
    for _ in range(2):
        await call(proxy.master, door[0], "/other", *door[1:], source=NODE)
        await knock(proxy.lease(other), service_header("/door"))
        await other.publish(proxy.master)
    # In another name, the registration is not the node's.
    code, text, _ = await evil.call(proxy.master, *door)
    assert (code, "has the name /other" in text) == (-1, True)
    assert proxy.endpoint(other).caller_ids == ["/other"]
    assert victim.http.connections == 0
    # A registration by the node itself counts.
    own = f"rosrpc://{OTHER_NODE}:{other.tcpros_port}"
    await other.call(proxy.master, "registerService", "/add", own, other.uri)
    assert (await greet(proxy.lease(other), service_header()))["callerid"] == "/other"


@pytest.mark.parametrize("status", [301, 302, 303, 307, 308])
async def test_a_node_can_not_redirect_the_proxy(proxy, node, victim, status):
    await node.publish(proxy.master)
    location = f"Location: http://{OTHER_NODE}:{victim.port}/"
    answer = f"HTTP/1.1 {status} Go\r\n{location}\r\nContent-Length: 0\r\n\r\n".encode()
    node.answers = {"getBusStats": answer, "requestTopic": answer, "getPid": answer}
    for method in ("getBusStats", "requestTopic"):
        async with connect(proxy.lease(node)) as wire:
            await wire.send(post(xml(method, "/outside", "/chatter", [["TCPROS"]])))
            assert await wire.end() == "reset"
    assert victim.http.connections == 0


async def test_the_master_can_not_redirect_the_proxy(proxy, master, victim):
    location = f"Location: http://{OTHER_NODE}:{victim.port}/"
    answer = f"HTTP/1.1 307 Go\r\n{location}\r\nContent-Length: 0\r\n\r\n".encode()
    master.answers = {"getParam": answer, "getSystemState": answer}
    async with connect(proxy.master, NODE) as wire:
        await wire.send(post(xml("getParam", "/n", "/p")))
        assert await wire.end() == "reset"
    assert victim.http.connections == 0


@pytest.mark.usefixtures("_as_if_not_loopback")
async def test_the_proxys_own_ports_do_not_pass_for_nodes(make_proxy, master, node, monkeypatch):
    monkeypatch.setattr(
        "rosproxy.ros1.stack.PROBE_CHECK_INTERVAL_S", 60
    )  # a second probe would close the port
    proxy = await make_proxy()
    uri = f"http://{PROXY}:{proxy.settings.master_port}/"
    await node.call(proxy.master, "registerPublisher", "/t", "x/Y", uri)
    (endpoint,) = proxy.ros1.context.registry
    with pytest.raises(Fault, match="leads back"):
        await rpc((HOST, endpoint.port), "getPid", "/outside")
    assert not [call for call in master.named("getPid") if call == ("/outside",)]
    own = f"http://{PROXY}:{endpoint.port}/"
    await node.call(proxy.master, "registerPublisher", "/t2", "x/Y", own)
    assert len(proxy.ros1.context.registry) == 1


async def forge(master, name, port, inside, *topics):
    """Register at the master what a proxy would have registered."""
    uri = f"http://{HOST}:{port}/{inside}/"
    for topic in topics:
        await rpc(master.uri, "registerPublisher", name, topic, "x/Y", uri)
    return uri


async def test_forged_uris_at_the_master_are_refused_at_recovery(
    master, make_proxy, make_node, victim, caplog
):
    other = await make_node("/other", OTHER_NODE)
    other.published["/other/topic"] = "x/Y"
    proxy = await make_proxy(master_uri="http://127.0.1.1:9")
    first = proxy.settings.ports.listen.first
    await proxy.stop()
    await forge(master, "/outside_the_networks", first, "127.0.1.1:80", "/a", "/rosout")
    await forge(master, "/metadata", first + 1, "169.254.169.254:80", "/a")
    await forge(master, "/web", first + 2, f"{OTHER_NODE}:{victim.port}", "/a", "/rosout")
    await forge(master, "/wrong", first + 3, f"{OTHER_NODE}:{other.slave.address[1]}", "/a")
    await forge(master, "/unresolved", first + 4, "localhost:80", "/a")
    await forge(master, "/odd", first + 5, f"{OTHER_NODE}:1/{OTHER_NODE}/x", "/a")
    fresh = await make_proxy(
        port_range=str(proxy.settings.ports.listen), inside_network=("127.0.2.0/24",)
    )
    await until(lambda: fresh.app.status()["master"]["up"], "the master is found")
    await until(lambda: victim.http.connections, "the claim is looked into")
    await until(
        lambda: "none of the registered topics" in caplog.text, "the wrong claim is found out"
    )
    for port in range(first, first + 6):
        assert await refuses((HOST, port)), port
    assert caplog.text.count("is not in an inside network") == 3
    assert not await _reaches(victim, first + 2)


async def _reaches(victim: Victim, port: int) -> bool:
    before = len(victim.seen)
    await knock((HOST, port), post(xml("getBusStats", "/outside")))
    return len(victim.seen) > before


async def test_a_forged_claim_does_not_displace_the_real_node(master, make_proxy, make_node):
    proxy = await make_proxy()
    node = await make_node()
    await node.publish(proxy.master)
    port = proxy.endpoint(node).port
    uri = proxy.uri(node)
    await proxy.stop()
    topics = [f"/forged{i}" for i in range(20)]
    await forge(master, "/evil", port, f"{OTHER_NODE}:1", *topics)
    here = f"{NODE}:{node.slave.address[1]}"
    await forge(master, "/evil2", port + 1, here, *topics)
    fresh = await make_proxy(port_range=str(proxy.settings.ports.listen))
    await until(lambda: len(fresh.ros1.context.registry), "the node is found")
    await until(lambda: fresh.serves(node), "the node is served")
    assert fresh.uri(node) == uri
    assert (await rpc(uri, "getPid", "/outside"))[2] == node.pid
