"""Names from nodes and strangers: bounded in memory, in the status and in the log."""

import gzip
import json
import xmlrpc.client
from xmlrpc.client import Fault

import pytest

from rosproxy.ros1.protocol.name_lengths import LONGEST_NAME
from rosproxy.ros1.protocol.tcpros import encode_header
from rosproxy.shared.uris import LONGEST_URI
from tests.integration.net import (
    NODE,
    OUTSIDE,
    connect,
    exchange,
    greet,
    knock,
    post,
    rpc,
    service_header,
    topic_header,
    until,
    xml,
)

LONG = "/" + "x" * LONGEST_NAME
FORGED = "/a\n2026-01-01 00:00:00,000 ERROR   forged\u202e"
SMALL = 64 * 1024


def status_size(proxy) -> int:
    return len(json.dumps(proxy.app.status()))


@pytest.mark.parametrize(
    ("method", "given"),
    [
        ("registerPublisher", (LONG, "std_msgs/String")),
        ("registerSubscriber", ("/t", LONG)),
        ("registerService", (LONG, f"rosrpc://{NODE}:5000")),
        ("registerService", ("/s", f"rosrpc://{NODE}:5000/" + "x" * LONGEST_URI)),
    ],
)
async def test_a_long_name_is_refused_and_the_master_never_sees_it(
    proxy, master, node, method, given
):
    code, text, _ = await node.call(proxy.master, method, *given, node.uri)
    assert code == -1
    assert "characters, at most" in text
    assert not master.named(method)
    assert proxy.metric("refused_total", reason="long_name") == 1
    (problem,) = proxy.app.status()["problems"]
    assert problem["subject"] == "refused: long name"
    said = text.removeprefix("rosproxy: ")
    assert problem["text"] == f"from {NODE}: {method} of {node.name}: {said}"
    assert (await node.publish(proxy.master))[0] == 1


async def test_a_long_uri_and_a_long_caller_leave_no_endpoint(proxy, master, node):
    uri = f"http://{NODE}:5000/" + "x" * LONGEST_URI
    refused = await node.call(proxy.master, "registerPublisher", "/t", "*", uri)
    node.name = LONG
    also = await node.publish(proxy.master)
    assert (refused[0], also[0]) == (-1, -1)
    assert not proxy.app.status()["nodes"]
    assert status_size(proxy) < SMALL
    assert not master.named("registerPublisher")


async def test_in_a_multicall_only_the_long_ones_are_refused(proxy, master, node):
    calls = [
        {"methodName": "registerPublisher", "params": ["/talker", name, "*", node.uri]}
        for name in ("/a", LONG, "/b")
    ]
    (results,) = [await rpc(proxy.master, "system.multicall", calls, source=NODE)]
    assert [result[0][0] for result in results] == [1, -1, 1]
    assert [call[1] for call in master.named("registerPublisher")] == ["/a", "/b"]


async def test_a_node_registers_no_more_than_it_may(proxy, node, monkeypatch):
    monkeypatch.setattr("rosproxy.ros1.registry.endpoint.MOST_REGISTRATIONS", 3)
    codes = [(await node.publish(proxy.master, f"/t{n}"))[0] for n in range(5)]
    assert codes == [1, 1, 1, -1, -1]
    assert proxy.metric("refused_total", reason="too_many_names") == 2
    assert proxy.app.status()["nodes"][0]["publishes"] == ("/t0", "/t1", "/t2")
    await node.call(proxy.master, "unregisterPublisher", "/t0", node.uri)
    assert (await node.publish(proxy.master, "/t5"))[0] == 1


async def test_real_nodes_with_long_names_are_served(proxy, node):
    name = "/ns" * 80
    node.name = f"{name}/node"
    await node.publish(proxy.master, f"{name}/topic")
    asked = await rpc(proxy.uri(node), "requestTopic", "/out", f"{name}/topic", [["TCPROS"]])
    assert asked[0] == 1
    answer = await greet(proxy.lease(node), topic_header(f"{name}/topic", f"{name}/out"))
    assert answer["callerid"] == node.name


async def test_a_long_topic_in_a_call_to_a_node_is_refused(proxy, node):
    await node.publish(proxy.master)
    for method, params in (
        ("requestTopic", ("/out", LONG, [["TCPROS"]])),
        ("requestTopic", (LONG, "/chatter", [["TCPROS"]])),
        ("publisherUpdate", ("/master", LONG, [])),
    ):
        before = len(node.calls)
        assert (await rpc(proxy.uri(node), method, *params))[0] == -1
        assert method not in [call for call, _ in node.calls[before:]]


@pytest.mark.parametrize(
    "header",
    [
        topic_header(LONG),
        topic_header("/chatter", LONG),
        service_header(LONG),
        topic_header("/chatter", "x" * 900_000),
        encode_header({f"field{n}": "" for n in range(60_000)}),
    ],
    ids=["topic", "caller", "service", "huge", "many"],
)
async def test_a_connection_header_with_long_names_is_answered_with_an_error(proxy, node, header):
    await node.publish(proxy.master)
    assert "error" in await greet(proxy.lease(node), header)
    assert not node.headers
    assert proxy.metric("relay_errors_total", reason="bad header") == 1
    assert status_size(proxy) < SMALL


async def test_a_master_that_says_a_lot_is_quoted_in_short(make_proxy, master):
    proxy = await make_proxy()
    text = "<value>%s</value>" % ("x" * 4_000_000)
    fault = xmlrpc.client.dumps(Fault(1, "FAULT"), methodresponse=True)
    fault = fault.replace("<value><string>FAULT</string></value>", text)
    head = f"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: {len(fault)}\r\n\r\n"
    master.answers = {"getPid": (head + fault).encode()}
    await until(lambda: not proxy.metric("master_up"), "the master is taken for down")
    assert status_size(proxy) < SMALL


async def test_a_small_request_makes_no_large_log(start_process):
    """Packed, 8 KB may contain a URI of 8 MB, which must not enter the log or /status."""
    process = start_process(log_format="text")
    uri = f"http://{NODE}:5000/" + "x" * 8_000_000
    packed = gzip.compress(xml("registerPublisher", "/a", "/t", "*", uri))
    assert len(packed) < 10_000
    for _ in range(10):
        await knock(process.master, post(packed, "Content-Encoding: gzip"), NODE)
    for name in (FORGED, LONG):
        call = xml("registerPublisher", name, name, "*", f"http://{NODE}:5000/{name[1:]}")
        for _ in range(50):
            await exchange(process.master, post(call), NODE)
    await until(lambda: "at most" in process.text, "a refusal is logged")
    assert len(process.text) < SMALL
    assert not [line for line in process.log if line.startswith("2026-01-01")]
    assert "\u202e" not in process.text


async def test_reading_status_stays_small_whatever_was_registered(proxy, node):
    """The JSON has names unchanged, also hostile and long names."""
    await node.publish(proxy.master, FORGED)
    assert proxy.app.status()["nodes"][0]["publishes"] == (FORGED,)
    async with connect((proxy.settings.admin.host, proxy.settings.admin.port), OUTSIDE) as wire:
        await wire.send(b"GET /status HTTP/1.1\r\nHost: x\r\n\r\n")
        body = (await wire.reply()).body
    assert json.loads(body)["nodes"][0]["publishes"] == [FORGED]
    assert body.isascii()
