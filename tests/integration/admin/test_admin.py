"""The admin endpoint: health, readiness, metrics, status, and the probe of the range."""

import asyncio
import json
import socket
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from examples.demo.fake_http import End
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode
from rosproxy.telemetry.metrics import MOST_NAMES, Traffic
from tests.integration.conftest import MakeNode, MakeProxy
from tests.integration.net import (
    HOST,
    OUTSIDE,
    connect,
    exchange,
    post,
    read_header,
    rpc,
    service_header,
    topic_header,
    until,
    xml,
)
from tests.integration.proxy import Proxy

DEAD_HOST = "127.0.9.9"


async def ask(proxy: Proxy, path: str, verb: str = "GET") -> tuple[int, str]:
    """Status and text of a path of the admin endpoint."""
    address = (proxy.settings.admin.host, proxy.settings.admin.port)
    reply = await exchange(address, f"{verb} {path} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
    return reply.status, reply.body.decode()


async def status(proxy: Proxy) -> dict[str, Any]:
    return json.loads((await ask(proxy, "/status"))[1])


async def metrics(proxy: Proxy) -> dict[str, float]:
    """All samples, by name and labels: ``name{a=b,c=d}``."""
    code, text = await ask(proxy, "/metrics")
    assert code == 200
    samples = [s for family in text_string_to_metric_families(text) for s in family.samples]
    values = {f"{s.name}{_labels(s.labels)}": s.value for s in samples}
    assert len(values) == len(samples), "a sample twice"
    return values


def _labels(labels: dict[str, str]) -> str:
    listed = ",".join(f"{k}={v}" for k, v in sorted(labels.items()))
    return f"{{{listed}}}" if labels else ""


async def test_health_and_readiness_follow_the_master(
    make_proxy: MakeProxy, master: FakeMaster
) -> None:
    await master.stop()
    proxy = await make_proxy()
    await until(lambda: proxy.ros1.master_monitor.error, "the master was missed")
    code, text = await ask(proxy, "/readyz")
    assert code == 503
    assert text.startswith(f"master {master.uri}: ")
    assert await ask(proxy, "/healthz") == (200, "ok\n")
    await master.start()
    await until(lambda: proxy.ros1.master_monitor.up, "the master is seen")
    assert await ask(proxy, "/readyz") == (200, "ok\n")
    await master.stop()
    await until(lambda: not proxy.ros1.master_monitor.up, "the master was missed again")
    assert (await ask(proxy, "/readyz"))[0] == 503
    assert await ask(proxy, "/healthz") == (200, "ok\n")


async def test_not_ready_before_the_master_was_asked(
    make_proxy: MakeProxy, master: FakeMaster
) -> None:
    master.delay = 0.5
    proxy = await make_proxy()
    assert await ask(proxy, "/readyz") == (
        503,
        f"the proxy has not asked master {master.uri} yet\n",
    )
    assert (await status(proxy))["master"]["up"] is False


async def test_paths(proxy: Proxy) -> None:
    assert (await ask(proxy, "/nothing"))[0] == 404
    assert (await ask(proxy, "/probe"))[0] == 405


async def test_status_tells_everything_of_a_node(proxy: Proxy, node: FakeNode) -> None:
    await node.publish(proxy.master)
    await node.subscribe(proxy.master, "/back")
    await node.serve(proxy.master)
    async with connect(proxy.lease(node)) as wire:
        await wire.send(topic_header())
        await read_header(wire)
        document = await status(proxy)
    (told,) = document["nodes"]
    assert told["nodes"] == ["/talker"]
    assert told["uri"] == node.uri
    assert told["advertised_uri"] == proxy.uri(node)
    assert (told["publishes"], told["subscribes"], told["services"]) == (
        ["/chatter"],
        ["/back"],
        ["/add"],
    )
    (connection,) = told["connections"]
    assert (connection["name"], connection["caller_id"]) == ("/chatter", "/outside")
    assert connection["peer"] == OUTSIDE
    assert document["ports"]["used"] == 1
    assert document["master"]["up"]
    assert document["uptime"] >= 0


async def test_metrics_of_a_proxy_at_work(
    make_proxy: MakeProxy, make_node: MakeNode, master: FakeMaster
) -> None:
    proxy = await make_proxy()
    node = await make_node()
    dead = await make_node("/dead")
    for publisher in (node, dead):
        await publisher.publish(proxy.master)
    await node.serve(proxy.master)
    await dead.stop()
    await _talk(proxy, node)
    await rpc(proxy.lease(node), "getPid", "/outside")
    await until(lambda: not master.holds("publishers", "/dead"), "cleaned up")
    await until(lambda: proxy.metric("cleanups_total"), "counted")
    samples = await metrics(proxy)
    assert not [name for name in samples if "_created" in name]
    assert samples["rosproxy_buffered_bytes"] <= samples["rosproxy_buffered_bytes_limit"]
    assert samples["rosproxy_leases_used"] in (1, 2)
    assert samples["rosproxy_leases_used"] + samples["rosproxy_leases_free"] == 8
    assert samples["rosproxy_leases_blocked"] == 0
    assert samples["rosproxy_endpoints{state=ok}"] == 1
    assert samples["rosproxy_master_up"] == 1
    assert samples["rosproxy_open_connections"] == 0
    assert samples["rosproxy_cleanups_total"] == 1
    assert samples["rosproxy_relay_errors_total{reason=bad header}"] == 1
    assert samples["rosproxy_master_round_trip_seconds_count"] > 0
    calls = "rosproxy_xmlrpc_calls_total{api=%s,method=%s,outcome=answered}"
    assert samples[calls % ("master", "registerPublisher")] == 2
    assert samples[calls % ("slave", "getPid")] == 1
    assert samples["rosproxy_relayed_bytes_total{direction=inward,kind=topic,name=/chatter}"] >= 5
    assert samples["rosproxy_relayed_bytes_total{direction=outward,kind=topic,name=/chatter}"] >= 5
    assert samples["rosproxy_relayed_bytes_total{direction=outward,kind=service,name=/add}"] > 0
    assert samples["process_open_fds"] > 0
    assert any(name.startswith("rosproxy_build_info{version=") for name in samples)


async def test_a_silent_node_is_named_in_the_metrics(
    make_proxy: MakeProxy, make_node: MakeNode, node: FakeNode
) -> None:
    proxy = await make_proxy(cleanup_after=60.0)
    dead = await make_node("/dead")
    for publisher in (node, dead):
        await publisher.publish(proxy.master)
    assert not [name for name in await metrics(proxy) if "nodes_down{" in name]
    await dead.stop()
    await until(lambda: proxy.metric("nodes_down", node="/dead"), "the node counts as down")
    assert [name for name in await metrics(proxy) if "nodes_down{" in name] == [
        "rosproxy_nodes_down{node=/dead}"
    ]


async def _talk(proxy: Proxy, node: FakeNode) -> None:
    """A topic and a service over the relay, and a stranger."""
    for header in (topic_header(), service_header()):
        async with connect(proxy.lease(node)) as wire:
            await wire.send(header)
            await read_header(wire)
            await wire.send(b"hello")
            assert await wire.exactly(5) == b"hello"
    async with connect(proxy.lease(node)) as wire:
        await wire.send(b"\xff\xff\xff\x7fnonsense")
        await wire.outcome()
    await proxy.quiet()


async def test_an_open_connection_is_counted(proxy: Proxy, node: FakeNode) -> None:
    await node.publish(proxy.master)
    async with connect(proxy.lease(node)) as wire:
        await wire.send(topic_header())
        await read_header(wire)
        assert (await metrics(proxy))["rosproxy_open_connections"] == 1


async def test_strangers_cannot_multiply_series(proxy: Proxy, node: FakeNode) -> None:
    node.name_port_for_any_topic()
    await node.publish(proxy.master)
    for number in range(20):
        body = xml(f"method_{number}", "/outside")
        await exchange(proxy.lease(node), post(body))
        await exchange(proxy.master, post(body))
        async with connect(proxy.lease(node)) as wire:
            await wire.send(topic_header(f"/made_up_{number}", f"/caller_{number}"))
            await read_header(wire)
    await proxy.quiet()
    samples = await metrics(proxy)
    assert not [name for name in samples if "made_up" in name or "method_" in name]
    assert not [name for name in samples if "caller_" in name]
    key = "rosproxy_relayed_bytes_total{direction=outward,kind=topic,name=unregistered}"
    assert samples[key] > 0
    assert [name for name in samples if "method=other" in name]


def test_names_of_topics_are_bounded() -> None:
    traffic = Traffic()
    for number in range(MOST_NAMES + 50):
        traffic.add("topic", f"/topic_{number}", 1, 2)
    traffic.add("topic", "/topic_0", 1, 2)
    assert len(traffic.sent) == len(traffic.received) == MOST_NAMES + 1
    assert traffic.sent["topic", "other"] == 50
    assert traffic.received["topic", "/topic_0"] == 4


async def probe(proxy: Proxy) -> list[dict[str, Any]]:
    code, text = await ask(proxy, "/probe", "POST")
    assert code == 200
    return json.loads(text)["probes"]


async def test_probe_tries_the_lowest_and_the_highest_free_port(
    proxy: Proxy, node: FakeNode, master: FakeMaster
) -> None:
    await node.publish(proxy.master)
    params = dict(master.params)
    ports = proxy.settings.ports.listen
    before = proxy.ros1.context.registry.pool.free
    attempts = await probe(proxy)
    assert [p["port"] for p in attempts] == [ports.first + 1, ports.last]
    assert {(p["from_proxy"], p["from_master"]) for p in attempts} == {("ok", "ok")}
    assert attempts[0]["advertised"] == f"{HOST}:{ports.first + 1}"
    assert proxy.ros1.context.registry.pool.free == before
    assert master.params == params, "a parameter is left behind"
    assert not [name for name in master.nodes if "probe" in name]


async def test_probe_while_the_master_is_away(proxy: Proxy, master: FakeMaster) -> None:
    master.answers["system.multicall"] = End.RESET
    attempts = await probe(proxy)
    assert {(p["from_proxy"], p["from_master"]) for p in attempts} == {("ok", "unknown")}


async def test_probe_tells_that_the_master_does_not_get_through(
    make_proxy: MakeProxy, master: FakeMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rosproxy.ros1.range_probe.MASTER_TIMEOUT_S", 0.3)
    master.calls_back = False
    proxy = await make_proxy()
    (attempt,) = await probe(proxy)  # the master is not sent into the void twice
    assert (attempt["from_proxy"], attempt["from_master"]) == ("ok", "missed")
    assert proxy.ros1.context.registry.pool.free == 8


async def test_two_probes_at_once_do_not_meet(proxy: Proxy) -> None:
    both = await asyncio.gather(probe(proxy), probe(proxy))
    assert both[0] == both[1]


async def test_probe_of_a_full_range(make_proxy: MakeProxy, node: FakeNode) -> None:
    proxy = await make_proxy(ports=1)
    await node.publish(proxy.master)
    assert await probe(proxy) == []


async def test_probe_of_one_free_port(make_proxy: MakeProxy) -> None:
    assert len(await probe(await make_proxy(ports=1))) == 1


async def test_probe_finds_an_address_where_nobody_listens(
    make_proxy: MakeProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rosproxy.ros1.range_probe.MASTER_TIMEOUT_S", 0.3)
    proxy = await make_proxy(advertise_host=DEAD_HOST, bind="127.0.2.1")
    assert {p["from_proxy"] for p in await probe(proxy)} == {"refused"}


async def test_probe_finds_a_name_that_nobody_knows(
    make_proxy: MakeProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rosproxy.ros1.range_probe.MASTER_TIMEOUT_S", 0.3)
    proxy = await make_proxy(advertise_host="nobody.invalid")
    assert {p["from_proxy"] for p in await probe(proxy)} == {"unresolvable"}


@pytest.mark.parametrize(
    ("answer", "outcome"),
    [(b"SSH-2.0-OpenSSH_9.2\r\n", "stranger"), (b"", "closed"), (None, "stranger")],
)
async def test_probe_finds_somebody_else(
    make_proxy: MakeProxy, monkeypatch: pytest.MonkeyPatch, answer: bytes | None, outcome: str
) -> None:
    """The advertised port leads elsewhere: to a program that talks, hangs up, or says nothing."""
    monkeypatch.setattr("rosproxy.ros1.range_probe.MASTER_TIMEOUT_S", 0.2)
    monkeypatch.setattr("rosproxy.ros1.range_probe.PROBE_TIMEOUT_S", 0.5)

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(answer or b"")
        if answer is None:
            await reader.read()
        writer.close()

    proxy = await make_proxy(advertise_host=DEAD_HOST, bind="127.0.2.1", ports=1)
    port = proxy.settings.ports.listen.first
    async with await asyncio.start_server(serve, DEAD_HOST, port):
        assert {p["from_proxy"] for p in await probe(proxy)} == {outcome}


async def test_probe_is_not_deceived_by_who_knows_no_secret(
    make_proxy: MakeProxy, master: FakeMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stranger that calls the port under test does not count for the master."""
    monkeypatch.setattr("rosproxy.ros1.range_probe.MASTER_TIMEOUT_S", 0.6)
    monkeypatch.setattr("rosproxy.ros1.range_probe.PROBE_TIMEOUT_S", 0.5)
    master.calls_back = False
    proxy = await make_proxy(ports=1)
    trying = asyncio.create_task(probe(proxy))
    address = (HOST, proxy.settings.ports.listen.first)
    await until(lambda: proxy.ros1.context.registry.pool.free == 0, "the probe has begun")
    async with connect(address) as wire:
        await wire.send(post(xml("paramUpdate", "/master", "/guess", 1)))
        assert await wire.end() in ("closed", "reset")
    assert (await trying)[0]["from_master"] == "missed"


async def test_a_taken_admin_port_names_the_option(make_proxy: MakeProxy) -> None:
    from rosproxy.shared.setting_kinds import SettingError

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(SettingError, match="--admin-bind: "):
            await make_proxy(admin_bind=f"127.0.0.1:{port}")
