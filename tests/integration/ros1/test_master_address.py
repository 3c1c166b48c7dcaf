"""The master at a given address, independent of its name. The address may change."""

import json

import pytest

from examples.demo.fake_http import host_and_port
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode
from rosproxy.doctor.collect import collect
from rosproxy.doctor.facts import ReachOutcome
from rosproxy.shared.http.admin_client import AdminClient
from tests.integration.admin_calls import post, tell
from tests.integration.commands import admin_url, run
from tests.integration.conftest import MakeNode, MakeProxy
from tests.integration.net import MASTER, OUTSIDE, exchange, rpc, until
from tests.integration.proxy import Proxy

ELSEWHERE = "127.0.1.2"
NAME = "robot.invalid"


def uri_by_name(master: FakeMaster) -> str:
    return f"http://{NAME}:{host_and_port(master.uri)[1]}"


async def master_status(proxy: Proxy) -> dict[str, object]:
    address = (proxy.settings.admin.host, proxy.settings.admin.port)
    reply = await exchange(address, b"GET /status HTTP/1.1\r\nHost: x\r\n\r\n")
    status: dict[str, object] = json.loads(reply.body)["master"]
    return status


async def test_the_name_is_not_resolved_but_told(
    make_proxy: MakeProxy, master: FakeMaster, node: FakeNode
) -> None:
    proxy = await make_proxy(master_uri=uri_by_name(master), master_address=MASTER)
    assert (await node.publish(proxy.master))[0] == 1
    assert master.holds("publishers", "/chatter") == [proxy.uri(node)]
    told = {request.headers["host"] for request in master.requests}
    assert told == {f"{NAME}:{host_and_port(master.uri)[1]}"}
    status = await master_status(proxy)
    assert (status["address"], status["pinned"], status["up"]) == (MASTER, True, True)


async def test_without_it_the_status_tells_where_the_name_led(proxy: Proxy) -> None:
    await until(lambda: proxy.ros1.master_monitor.up, "the master is seen")
    status = await master_status(proxy)
    assert (status["address"], status["pinned"]) == (MASTER, False)


async def test_a_name_that_was_resolved(make_proxy: MakeProxy, master: FakeMaster) -> None:
    await master.stop()
    port = host_and_port(master.uri)[1]
    await master.start("127.0.0.1")
    proxy = await make_proxy(master_uri=f"http://localhost:{port}")
    await until(lambda: proxy.ros1.master_monitor.up, "the master is seen")
    assert (await master_status(proxy))["address"] in ("127.0.0.1", "::1")


async def test_the_master_moves(
    make_proxy: MakeProxy, master: FakeMaster, node: FakeNode, make_node: MakeNode
) -> None:
    proxy = await make_proxy(master_uri=uri_by_name(master), master_address=MASTER)
    await node.publish(proxy.master)
    await master.stop()
    await master.start(ELSEWHERE)
    await until(lambda: not proxy.ros1.master_monitor.up, "the master is missed")
    assert await tell(proxy, "/master-address", address=ELSEWHERE) == {"address": ELSEWHERE}
    await until(lambda: proxy.ros1.master_monitor.up, "the master is found again")
    assert (await master_status(proxy))["address"] == ELSEWHERE
    late = await make_node("/late")
    assert (await late.publish(proxy.master))[0] == 1
    assert master.holds("publishers", "/chatter") == [proxy.uri(node), proxy.uri(late)]


async def test_after_a_change_of_address_the_next_master_gets_the_calls(
    make_proxy: MakeProxy, master: FakeMaster, make_node: MakeNode
) -> None:
    """The proxy does not use kept connections to the former master."""
    other = FakeMaster(ELSEWHERE, host_and_port(master.uri)[1])
    await other.start()
    try:
        proxy = await make_proxy(master_uri=uri_by_name(master), master_address=MASTER)
        await (await make_node("/one")).publish(proxy.master, "/a")
        await tell(proxy, "/master-address", address=ELSEWHERE)
        await (await make_node("/two")).publish(proxy.master, "/b")
        assert not master.holds("publishers", "/b")
        assert other.holds("publishers", "/b")
        await until(lambda: other.holds("publishers", "/a"), "/a is registered, too")
    finally:
        await other.stop()


@pytest.mark.parametrize(
    "body", ['{"address": "robot"}', "{}", '{"adress": "192.0.2.7"}', "nonsense"]
)
async def test_no_address(proxy: Proxy, body: str) -> None:
    reply = await post(proxy, "/master-address", body)
    assert reply.status == 400
    assert b"address" in reply.body or b"the body: must be JSON" in reply.body
    assert proxy.ros1.context.upstream.master_address is None


async def test_only_the_master_may_control_nodes_and_it_is_known_by_its_address(
    make_proxy: MakeProxy, master: FakeMaster, node: FakeNode
) -> None:
    proxy = await make_proxy(
        master_uri=uri_by_name(master), master_address=MASTER, slave_control="master"
    )
    await node.call(proxy.master, "subscribeParam", node.uri, "/x")
    assert (await rpc(proxy.lease(node), "paramUpdate", "/master", "/x", 1, source=MASTER))[0] == 1
    assert (await rpc(proxy.lease(node), "paramUpdate", "/x", "/x", 1, source=OUTSIDE))[0] == -1


async def test_an_outside_subscriber_on_the_masters_host_is_told_at_its_address(
    make_proxy: MakeProxy, master: FakeMaster, node: FakeNode, make_node: MakeNode
) -> None:
    """The subscriber's URI has the name of the master's host. After a restart of the proxy, this
    subscriber gets updates.
    """
    listener = await make_node("/listener", MASTER, NAME)
    await listener.subscribe(host_and_port(master.uri))
    proxy = await make_proxy(master_uri=uri_by_name(master), master_address=MASTER)
    await node.publish(proxy.master)
    await proxy.restart()
    await until(lambda: [] in listener.updates(), "the subscriber gets an empty update")


async def test_the_doctor_asks_the_master_at_its_address(
    make_proxy: MakeProxy, master: FakeMaster, make_node: MakeNode
) -> None:
    on_its_host = await make_node("/on_robot", MASTER, NAME)
    await on_its_host.publish(host_and_port(master.uri))
    proxy = await make_proxy(master_uri=uri_by_name(master), master_address=MASTER)
    facts = await collect(AdminClient(admin_url(proxy)))
    assert facts.master is not None
    assert (facts.master.addresses, facts.master.attempt.reach) == (
        (MASTER,),
        ReachOutcome.ANSWERED,
    )
    assert facts.nodes["/on_robot"].addresses == (MASTER,)
    assert facts.nodes["/on_robot"].attempt.reach is ReachOutcome.ANSWERED


async def test_the_doctor_without_a_proxy_is_told_the_address(master: FakeMaster) -> None:
    admin = AdminClient("127.0.0.1:9")
    facts = await collect(admin, uri_by_name(master), master_address=MASTER)
    assert facts.admin_error
    assert facts.master is not None
    assert facts.master.attempt.reach is ReachOutcome.ANSWERED


async def test_the_doctors_option(master: FakeMaster) -> None:
    words = ("doctor", "--admin", "127.0.0.1:9", "--master-uri", uri_by_name(master))
    result = await run(*words, ROSPROXY_MASTER_ADDRESS=MASTER)
    assert "resolve" not in result.out
    wrong = await run(*words, ROSPROXY_MASTER_ADDRESS="robot")
    assert (wrong.code, wrong.err) == (
        2,
        "rosproxy: --master-address: 'robot' is not an IP address such as 192.0.2.7\n",
    )
