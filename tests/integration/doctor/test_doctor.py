"""``rosproxy doctor`` at running proxies: facts, and findings about faults that the tests make."""

import asyncio
import json
from copy import deepcopy
from typing import Any

import pytest

from examples.demo.fake_http import End, FakeHttpServer, FakeRequest, free_ports, ok, value
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode, Header
from rosproxy.doctor.collect import collect
from rosproxy.doctor.rules import diagnose
from rosproxy.ros1.protocol.tcpros import encode_header
from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity
from rosproxy.shared.http.admin_client import AdminClient
from tests.integration.commands import admin_url, run
from tests.integration.conftest import MakeNode, MakeProxy
from tests.integration.net import (
    HOST,
    MASTER,
    OUTSIDE,
    connect,
    read_header,
    rpc,
    topic_header,
    until,
)
from tests.integration.proxy import Proxy

NOBODY = "http://127.0.0.1:1"


@pytest.fixture
async def listener(make_node: MakeNode, master: FakeMaster) -> FakeNode:
    """A node outside that subscribes to /chatter."""
    node = await make_node("/listener", OUTSIDE)
    await register(master, node, "registerSubscriber")
    node.subscribed["/chatter"] = "std_msgs/String"
    return node


async def register(
    master: FakeMaster, node: FakeNode, method: str, topic: str = "/chatter"
) -> None:
    """Register a node outside, at the real master."""
    await rpc(master.uri, method, node.name, topic, "std_msgs/String", node.uri)


async def examine(proxy: Proxy | None, *names: str, master_uri: str = "") -> list[DoctorFinding]:
    """All findings."""
    admin = AdminClient(admin_url(proxy)) if proxy else None
    return diagnose(await collect(admin, master_uri, "", names))


async def faults(proxy: Proxy | None, *names: str, master_uri: str = "") -> list[DoctorFinding]:
    """The findings that are more than notes."""
    findings = await examine(proxy, *names, master_uri=master_uri)
    return [f for f in findings if f.severity >= Severity.WARNING]


async def only(proxy: Proxy | None, *names: str, master_uri: str = "") -> DoctorFinding:
    """The only fault."""
    (finding,) = await faults(proxy, *names, master_uri=master_uri)
    return finding


def bus(*rows: tuple[str, str, str]) -> bytes:
    """An answer to getBusInfo: (peer, direction, topic) of each connection."""
    listed = [[n, peer, way, "TCPROS", topic, True] for n, (peer, way, topic) in enumerate(rows)]
    return value([1, "bus info", listed])


async def test_a_sound_system(
    proxy: Proxy, node: FakeNode, listener: FakeNode, master: FakeMaster
) -> None:
    await node.publish(proxy.master)
    await until(lambda: proxy.endpoint(node).health.state == "ok", "the node was probed")
    findings = await examine(proxy)
    assert {f.severity for f in findings} == {Severity.OK}, findings
    texts = " ".join(f.text for f in findings)
    assert f"{master.uri} answers in" in texts
    assert f"the master reaches {HOST}, port " in texts
    assert "1 of 1 answer" in texts
    assert "2 registered, none with faults" in texts


async def test_it_leaves_nothing_behind(proxy: Proxy, node: FakeNode, master: FakeMaster) -> None:
    await node.publish(proxy.master)
    before = deepcopy((master.tables["publishers"], master.nodes, master.params))
    await examine(proxy, "/chatter")
    assert (master.tables["publishers"], master.nodes, master.params) == before


async def test_a_node_that_has_ended(make_proxy: MakeProxy, node: FakeNode) -> None:
    proxy = await make_proxy(cleanup_after=60)
    await node.publish(proxy.master)
    await node.stop()
    await until(lambda: proxy.endpoint(node).health.down, "the node was missed")
    finding = await only(proxy)
    assert (finding.subject, finding.severity) == ("/talker", Severity.ERROR)
    assert "has ended without unregistering" in finding.text


async def test_a_node_that_hangs(make_proxy: MakeProxy, node: FakeNode) -> None:
    proxy = await make_proxy(cleanup_after=60)
    await node.publish(proxy.master)
    node.hang = True
    await until(lambda: proxy.endpoint(node).health.down, "the node was missed")
    assert "the node hangs" in (await only(proxy)).text


async def test_an_outside_node_that_is_gone(
    proxy: Proxy, node: FakeNode, listener: FakeNode, master: FakeMaster
) -> None:
    await node.publish(proxy.master)
    await listener.stop()
    # The master of the tests is on loopback, so nodes on loopback are no fault if they answer.
    assert (await only(proxy)).subject == "/listener"


async def test_an_outside_node_of_an_unknown_host(proxy: Proxy, master: FakeMaster) -> None:
    await rpc(master.uri, "registerPublisher", "/far", "/t", "a/B", "http://missing.invalid:4/")
    findings = [f for f in await faults(proxy) if f.subject == "/far"]
    assert "the host name missing.invalid can't be resolved" in findings[0].text


async def test_a_stale_registration(proxy: Proxy, node: FakeNode, master: FakeMaster) -> None:
    await node.publish(proxy.master)
    port = proxy.settings.ports.listen.last
    uri = f"http://{HOST}:{port}/127.0.2.99:4/"
    await rpc(master.uri, "registerPublisher", "/ghost", "/t", "a/B", uri)
    await rpc(master.uri, "registerService", "/ghost", "/s", f"rosrpc://{HOST}:{port}", uri)
    findings = await faults(proxy)
    assert [f.subject for f in findings] == ["/ghost", "/ghost"]
    assert {f.check for f in findings} == {"stale registration"}


async def test_the_master_is_away(proxy: Proxy, master: FakeMaster) -> None:
    await master.stop()
    findings = [f for f in await faults(proxy) if f.severity is Severity.ERROR]
    assert [f.check for f in findings] == ["master"]
    assert "refuses connections" in findings[0].text


async def test_the_masters_path_is_wrong(make_proxy: MakeProxy) -> None:
    async def respond(request: FakeRequest) -> bytes:
        if request.verb == "POST" and request.path == "/":
            return value([1, "", 7])
        return b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n"

    fake = FakeHttpServer(respond)
    await fake.start(MASTER)
    proxy = await make_proxy(master_uri=f"http://{MASTER}:{fake.address[1]}/ros")
    findings = [f for f in await faults(proxy) if f.check == "master"]
    await until(lambda: proxy.app.state().master.error, "the master was asked")
    error = proxy.app.state().master.error
    await proxy.stop()
    await fake.stop()
    assert "not at the path /ros" in findings[0].text
    assert f"Set --master-uri http://{MASTER}:{fake.address[1]} " in error


async def test_something_else_answers_for_the_master(make_proxy: MakeProxy) -> None:
    async def respond(request: FakeRequest) -> bytes:
        return ok(b"<html>It works!</html>")

    fake = FakeHttpServer(respond)
    await fake.start(MASTER)
    proxy = await make_proxy(master_uri=f"http://{MASTER}:{fake.address[1]}/")
    findings = [f for f in await faults(proxy) if f.check == "master"]
    await proxy.stop()
    await fake.stop()
    assert "is no ROS master" in findings[0].text


async def test_the_proxy_is_its_own_master(make_proxy: MakeProxy) -> None:
    port = free_ports(1)
    proxy = await make_proxy(master_uri=f"http://127.0.0.1:{port}", master_port=port)
    findings = [f for f in await faults(proxy) if f.check == "master"]
    assert "leads back to this proxy itself" in findings[0].text


async def test_the_published_master(make_proxy: MakeProxy) -> None:
    proxy = await make_proxy(publish_master=free_ports(1))
    (finding,) = [f for f in await examine(proxy) if f.check == "published master"]
    assert finding.severity is Severity.OK


async def connected_pair(proxy: Proxy, node: FakeNode) -> None:
    await node.publish(proxy.master)
    node.answers["getBusInfo"] = bus(("/listener", "o", "/chatter"))


async def test_a_topic_whose_pair_is_connected(
    proxy: Proxy, node: FakeNode, listener: FakeNode
) -> None:
    await connected_pair(proxy, node)
    async with connect(proxy.lease(node)) as wire:
        await wire.send(topic_header(caller="/listener"))
        await read_header(wire)
        findings = await examine(proxy, "/chatter")
    (pair,) = [f for f in findings if f.check == "pair"]
    assert pair.severity is Severity.OK
    assert pair.text.startswith("connected, ")
    assert pair.text.endswith(" just now")


async def test_types_that_differ(proxy: Proxy, node: FakeNode, listener: FakeNode) -> None:
    await node.publish(proxy.master)
    listener.subscribed["/chatter"] = "std_msgs/Int32"
    finding = await only(proxy, "/talker", "/listener")
    assert "types differ: /talker publishes std_msgs/String, " in finding.text
    assert "subscribes to std_msgs/Int32" in finding.text


async def test_a_subscriber_that_did_not_come(
    proxy: Proxy, node: FakeNode, listener: FakeNode
) -> None:
    await node.publish(proxy.master)
    finding = await only(proxy, "/chatter")
    assert "/listener has not connected" in finding.text


async def outside_publisher(master: FakeMaster, make_node: MakeNode) -> FakeNode:
    """A node outside that publishes /chatter, to a subscriber that is there already."""
    node = await make_node("/robot", OUTSIDE)
    await register(master, node, "registerPublisher")
    node.published["/chatter"] = "std_msgs/String"
    return node


async def refuse(
    node: FakeNode, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, header: Header
) -> None:
    """Answer a subscriber like a publisher with another message definition."""
    writer.write(encode_header({"error": "md5sums do not match"}))


async def test_data_ports_of_a_publisher_outside(
    proxy: Proxy, node: FakeNode, master: FakeMaster, make_node: MakeNode
) -> None:
    await node.subscribe(proxy.master)
    robot = await outside_publisher(master, make_node)
    assert "md5sum" in (await only(proxy, "/chatter")).text
    robot.stream = refuse
    assert "md5sums do not match" in (await only(proxy, "/chatter")).text
    robot.answers["requestTopic"] = value([1, "", ["TCPROS", "missing.invalid", 4]])
    assert (
        "missing.invalid:4 as its data port: the host name can't be resolved here"
        in (await only(proxy, "/chatter")).text
    )
    robot.answers["requestTopic"] = value([1, "", ["TCPROS", OUTSIDE, 1]])
    assert (
        f"{OUTSIDE}:1 as its data port: connection refused" in (await only(proxy, "/chatter")).text
    )
    robot.answers["requestTopic"] = value([0, "no", 0])
    assert "gives no data port" in (await only(proxy, "/chatter")).text


@pytest.mark.parametrize("answer", [value(7), value([1, "", "x"]), ok(b"no xml"), End.RESET])
async def test_nodes_that_talk_nonsense_do_no_harm(
    proxy: Proxy, node: FakeNode, listener: FakeNode, answer: Any
) -> None:
    await connected_pair(proxy, node)
    for method in ("getBusInfo", "getPublications", "requestTopic", "getSubscriptions"):
        node.answers[method] = listener.answers[method] = answer
    assert await examine(proxy, "/chatter")


async def test_services(proxy: Proxy, node: FakeNode) -> None:
    await node.serve(proxy.master)
    (finding,) = [f for f in await examine(proxy, "/add") if f.check == "pair"]
    assert finding.severity is Severity.OK
    assert node.headers[-1]["probe"] == "1"
    await node.tcpros.stop()
    finding = next(f for f in await faults(proxy, "/add") if f.check == "pair")
    assert "connection refused" in finding.text


async def test_without_a_proxy_the_master_and_its_nodes_are_looked_at(
    listener: FakeNode, master: FakeMaster
) -> None:
    findings = diagnose(await collect(AdminClient(NOBODY), master.uri, "127.0.0.1", ("/chatter",)))
    errors = {f.check for f in findings if f.severity is Severity.ERROR}
    assert errors == {"admin", "pair"}


async def test_the_look_from_outside(
    proxy: Proxy, node: FakeNode, listener: FakeNode, master: FakeMaster
) -> None:
    await connected_pair(proxy, node)
    assert not await faults(None, master_uri=master.uri)
    (pair,) = [
        f for f in await examine(None, "/chatter", master_uri=master.uri) if f.check == "pair"
    ]
    assert pair.text == "connected"
    await proxy.stop()
    finding = await only(None, master_uri=master.uri)
    assert "registered through a rosproxy" in finding.text


async def test_the_command(proxy: Proxy, node: FakeNode, master: FakeMaster) -> None:
    await node.publish(proxy.master)
    sound = await run("doctor", "--admin", admin_url(proxy))
    assert (sound.code, sound.err) == (0, "")
    assert sound.out.endswith("Nothing wrong was found.\n")
    wrong = await run("doctor", "chatter", "--json", ROSPROXY_ADMIN=admin_url(proxy))
    assert (wrong.code, wrong.err) == (1, "")
    told = json.loads(wrong.out)
    assert told["ok"] is False
    assert told["findings"][-1]["subject"] == "/chatter"
    outside = await run("doctor", "--outside", ROS_MASTER_URI=master.uri)
    assert outside.code == 0
    named = f"http://robot.invalid:{master.uri.rstrip('/').rpartition(':')[2]}"
    outside = await run("doctor", "--outside", ROS_MASTER_URI=named)
    assert outside.code == 1
    outside = await run("doctor", "--outside", "--master-address", MASTER, ROS_MASTER_URI=named)
    assert outside.code == 0


async def test_usage() -> None:
    for words in (
        ("doctor", "--admin", "nonsense"),
        ("doctor", "--outside"),
        ("doctor", "--master-uri", "robot"),
        ("doctor", "--what"),
    ):
        result = await run(*words)
        assert (result.code, result.out) == (2, ""), words
        assert "Traceback" not in result.err


async def test_many_nodes_are_looked_at_together(
    proxy: Proxy, master: FakeMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hundred nodes that do not answer must not take a hundred time-outs."""
    monkeypatch.setattr("rosproxy.doctor.graph_survey.ANSWER_TIMEOUT_S", 0.5)
    silent = FakeHttpServer(hang)
    await silent.start(OUTSIDE)
    for number in range(100):
        uri = f"http://{OUTSIDE}:{silent.address[1]}/"
        await rpc(master.uri, "registerPublisher", f"/n{number}", "/t", "a/B", uri)
    started = asyncio.get_running_loop().time()
    findings = await faults(proxy)
    await silent.stop()
    assert len([f for f in findings if f.subject.startswith("/n")]) == 100
    assert asyncio.get_running_loop().time() - started < 25  # in turn: 50


async def hang(_request: FakeRequest) -> End:
    return End.HANG
