"""The parameter at the master with the proxy's leases: maintained, bounded, and only a claim."""

from asyncio import StreamReader, StreamWriter
from functools import partial

import pytest

from examples.demo.fake_http import value
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode, Header
from rosproxy.ros1.protocol.tcpros import encode_header
from rosproxy.ros1.protocol.xmlrpc.limits import LEASES
from tests.integration.conftest import MakeNode, MakeProxy
from tests.integration.net import HOST, NODE, OTHER_NODE, looks, refuses, rpc, until
from tests.integration.proxy import Proxy


def parameter(proxy: Proxy) -> str:
    return f"/rosproxy/leases_{HOST.replace('.', '_')}_{proxy.settings.ports.listen.first}"


def line(proxy: Proxy, node: FakeNode) -> str:
    return f"{proxy.lease(node)[1]} /{node.address}:{node.slave.address[1]}/"


async def test_it_is_there_before_the_master_knows_the_node(
    proxy: Proxy, master: FakeMaster, node: FakeNode
) -> None:
    await node.publish(proxy.master)
    methods = [method for method, _ in master.calls]
    assert methods.index("setParam") < methods.index("registerPublisher")
    assert master.params == {parameter(proxy): f"{line(proxy, node)}\n"}


async def test_the_parameter_goes_with_the_last_lease(
    proxy: Proxy, master: FakeMaster, node: FakeNode
) -> None:
    await node.publish(proxy.master)
    await node.call(proxy.master, "unregisterPublisher", "/chatter", node.uri)
    await until(lambda: not master.params, "the parameter is deleted")


TOO_LONG = ("x" * (LEASES.size + 1), [1] * LEASES.elements)


@pytest.mark.parametrize(
    "written", ["", "nonsense", "1 /127.0.2.99:1/\n", 7, ["x"], None, *TOO_LONG]
)
async def test_foreign_changes_of_the_parameter_are_undone(
    proxy: Proxy, master: FakeMaster, node: FakeNode, written: object
) -> None:
    await node.publish(proxy.master)
    kept = dict(master.params)
    master.params.clear()
    if written is not None:
        await rpc(master.uri, "setParam", "/somebody", parameter(proxy), written)
    await until(lambda: master.params == kept, "the parameter is restored")


@pytest.mark.parametrize("written", ["", "nonsense\n" * 1000, 7, ["x"], {"a": "b"}, *TOO_LONG])
async def test_a_node_that_nothing_is_remembered_of_registers_again(
    proxy: Proxy, master: FakeMaster, node: FakeNode, written: object
) -> None:
    await node.publish(proxy.master)

    async def overwrite() -> None:
        master.params[parameter(proxy)] = written

    await proxy.restart(overwrite)
    await node.publish(proxy.master)
    assert await proxy.serves(node)
    assert master.holds("publishers", "/chatter") == [proxy.uri(node)]


async def test_a_node_is_believed_for_itself_alone(
    proxy: Proxy, master: FakeMaster, node: FakeNode, make_node: MakeNode
) -> None:
    """A forged parameter has another node at the port of the node."""
    other = await make_node("/other", OTHER_NODE)
    other.published = {"/rosout": "rosgraph_msgs/Log", "/else": "std_msgs/String"}
    await node.publish(proxy.master)
    lease = proxy.lease(node)

    async def forge() -> None:
        master.params[parameter(proxy)] = f"{lease[1]} /{OTHER_NODE}:{other.slave.address[1]}/\n"

    await proxy.restart(forge)
    await until(partial(refuses, lease), "the port refuses")
    await looks(master)
    assert await refuses(lease)


async def leave_behind(master: FakeMaster, uri: str) -> None:
    """Register a gone node with this slave URI at the master."""
    await rpc(master.uri, "registerPublisher", "/former", "/former/topic", "x/Y", uri)
    service = uri.replace("http://", "rosrpc://").rstrip("/")
    await rpc(master.uri, "registerService", "/former", "/former/service", service, uri)


@pytest.mark.parametrize("serves", [False, True], ids=["has a topic", "only serves"])
async def test_a_node_does_not_answer_for_the_one_before_at_its_port(
    proxy: Proxy, master: FakeMaster, node: FakeNode, serves: bool
) -> None:
    """The URI of both is the same."""
    await (node.serve(proxy.master) if serves else node.publish(proxy.master))
    uri = proxy.uri(node)
    await leave_behind(master, uri)
    await proxy.restart()
    await until(lambda: "/former" not in master.nodes, "/former is unregistered")
    assert set(master.nodes) == {node.name}
    assert await proxy.serves(node)
    reason = "[/former] Reason: new node registered with same name"
    assert (await rpc(uri, "shutdown", "/master", reason))[0] == 1
    assert "shutdown" not in [method for method, _ in node.calls]


async def only_own_services(
    node: FakeNode, reader: StreamReader, writer: StreamWriter, header: Header
) -> None:
    """Answer like nodes: for a service of another node with an error and without a name."""
    known = header.get("service", node.name).startswith(node.name)
    answer = {"callerid": node.name} if known else {"error": "no such service"}
    writer.write(encode_header(answer))


async def test_rosout_alone_confirms_no_name_beside_another(
    proxy: Proxy, master: FakeMaster, node: FakeNode
) -> None:
    """Every node has /rosout. The proxy registers unknown topics under the confirmed name."""
    node.stream = only_own_services
    await node.publish(proxy.master, "/rosout")
    await node.serve(proxy.master, f"{node.name}/get_loggers")
    node.published["/unknown"] = "std_msgs/String"
    uri = proxy.uri(node)
    await rpc(master.uri, "registerPublisher", "/former", "/rosout", "rosgraph_msgs/Log", uri)
    service = uri.replace("http://", "rosrpc://").rstrip("/")
    await rpc(master.uri, "registerService", "/former", "/former/get_loggers", service, uri)

    await proxy.restart()

    await until(lambda: "/former" not in master.nodes, "/former is unregistered")
    await until(lambda: master.holds("publishers", "/unknown") == [uri], "/unknown is registered")
    assert await proxy.serves(node)


async def test_old_registrations_at_a_port_are_removed_though_another_node_has_the_port(
    make_proxy: MakeProxy, master: FakeMaster, node: FakeNode
) -> None:
    proxy = await make_proxy(cleanup_after=0.3)
    await node.publish(proxy.master)
    uri = proxy.uri(node)

    async def forget() -> None:
        await node.call(master.uri, "unregisterPublisher", "/chatter", uri)
        await leave_behind(master, uri)
        master.params.clear()

    await proxy.restart(forget)
    await node.publish(proxy.master)
    assert proxy.uri(node) == uri
    await until(lambda: set(master.nodes) == {node.name}, "the old registrations are removed")
    assert master.tables["services"] == {}
    assert await proxy.serves(node)


async def test_a_master_that_refuses_the_parameter_is_a_problem(
    proxy: Proxy, master: FakeMaster, node: FakeNode
) -> None:
    """Another proxy is in between, with a policy."""
    master.answers["setParam"] = value([-1, "denied", 0])
    assert (await node.publish(proxy.master))[0] == 1
    assert await proxy.serves(node)
    (problem,) = proxy.app.status()["problems"]
    assert problem["subject"] == parameter(proxy)
    assert "denied" in problem["text"]
    del master.answers["setParam"]
    await until(lambda: parameter(proxy) in master.params, "the master keeps the parameter")
    assert not proxy.app.status()["problems"]


async def test_a_former_versions_uris_are_found_and_registered_anew(
    proxy: Proxy, master: FakeMaster, node: FakeNode
) -> None:
    await node.publish(proxy.master)
    await node.serve(proxy.master)
    lease = proxy.lease(node)
    former = f"http://{HOST}:{lease[1]}/{NODE}:{node.slave.address[1]}/"

    async def turn_back() -> None:
        master.params.clear()
        for method, names in (
            ("registerPublisher", ["/chatter", "std_msgs/String"]),
            ("registerService", ["/add", f"rosrpc://{HOST}:{lease[1]}"]),
        ):
            await rpc(master.uri, method, node.name, *names, former)

    await proxy.restart(turn_back)
    await until(
        lambda: master.nodes.get(node.name) == f"http://{HOST}:{lease[1]}/", "the URI has no path"
    )
    assert proxy.lease(node) == lease
    assert await proxy.serves(node)
    assert master.holds("publishers", "/chatter") == [proxy.uri(node)]
    assert not [call for call in node.calls if call[0] == "shutdown"]
