"""Policy: denied names are hidden outside, unchanged inside, and refused when requested."""

import asyncio
import json
from xmlrpc.client import Binary

import pytest

from examples.demo.fake_node import echo
from rosproxy.ros1.protocol.tcpros import encode_header
from tests.integration.admin_calls import post, tell
from tests.integration.net import (
    NODE,
    OTHER_NODE,
    PROXY,
    THIRD_NODE,
    connect,
    exchange,
    greet,
    looks,
    read_header,
    rpc,
    service_header,
    topic_header,
    until,
    xml,
)
from tests.integration.net import post as http_post

TCPROS = [["TCPROS"]]
PATIENT = {"cleanup_after": 0.0, "linger": 60.0}
OUTSIDE_PUBLISHER = "http://127.0.1.9:4711/"


async def told(proxy, *rules, mode="enforce", name="administrator"):
    """Send new rules. Return the numbers of hidden and shown registrations, and of cut
    connections.
    """
    layer = {"name": name, "mode": mode, "rules": list(rules), "addresses": None}
    answer = await tell(proxy, "/policy", layers=[layer])
    return answer["hidden"], answer["shown"], answer["cut"]


async def denied(proxy, kind, mode="enforce"):
    return proxy.metric("policy_denied_total", kind=kind, mode=mode)


# 1. Hidden outside, unchanged inside


async def test_a_denied_topic_is_hidden_outside_and_found_inside(make_proxy, master, make_node):
    proxy = await make_proxy(policy="deny publish /camera/*")
    talker = await make_node("/talker")
    listener = await make_node("/listener", OTHER_NODE)
    await talker.publish(proxy.master, "/odom")
    reply = await talker.publish(proxy.master, "/camera/front")
    assert reply == [1, "Registered [/talker] as publisher of [/camera/front]", []]
    assert master.holds("publishers", "/odom") == [proxy.uri(talker)]
    assert master.holds("publishers", "/camera/front") == []
    assert await listener.subscribe(proxy.master, "/camera/front") == [
        1,
        "Subscribed to [/camera/front]",
        [talker.uri],
    ]
    assert master.holds("subscribers", "/camera/front") == [proxy.uri(listener)]
    assert await denied(proxy, "publish") == 1


async def test_subscribers_inside_hear_of_hidden_publishers_that_come_and_go(
    make_proxy, master, make_node
):
    proxy = await make_proxy(policy="deny publish /chatter by /talker")
    listener = await make_node("/listener", OTHER_NODE)
    await listener.subscribe(proxy.master)
    master.register("publishers", "/chatter", "/outside", OUTSIDE_PUBLISHER)
    talker = await make_node("/talker")
    await talker.publish(proxy.master)
    await until(
        lambda: listener.updates()[-1:] == [[OUTSIDE_PUBLISHER, talker.uri]],
        "the subscriber gets both publishers",
    )
    shown = await make_node("/shown", THIRD_NODE)
    await shown.publish(proxy.master)
    await until(
        lambda: listener.updates()[-1] == [OUTSIDE_PUBLISHER, shown.uri, talker.uri],
        "the proxy completes the master's list",
    )
    ended = await talker.call(proxy.master, "unregisterPublisher", "/chatter", talker.uri)
    assert ended == [1, "Unregistered [/talker] as provider of [/chatter]", 1]
    await until(
        lambda: listener.updates()[-1] == [OUTSIDE_PUBLISHER, shown.uri],
        "the subscriber gets the end",
    )
    again = await talker.call(proxy.master, "unregisterPublisher", "/chatter", talker.uri)
    assert again[::2] == [1, 0]


async def test_a_hidden_service_is_found_inside_alone(make_proxy, master, make_node):
    proxy = await make_proxy(policy="deny serve /add")
    server = await make_node("/server")
    client = await make_node("/client", OTHER_NODE)
    assert await server.serve(proxy.master) == [
        1,
        "Registered [/server] as provider of [/add]",
        1,
    ]
    assert master.holds("services", "/add") == []
    reply = await client.call(proxy.master, "lookupService", "/add")
    assert reply == [1, f"rosrpc URI: [{server.service_api}]", server.service_api]
    assert (await client.call(proxy.master, "lookupNode", "/server"))[2] == server.uri
    ended = await server.call(proxy.master, "unregisterService", "/add", server.service_api)
    assert ended == [1, "Unregistered [/server] as provider of [/add]", 1]
    assert (await client.call(proxy.master, "lookupService", "/add"))[0] == -1


async def test_tools_inside_see_the_whole_graph(make_proxy, master, make_node):
    proxy = await make_proxy(policy="deny publish /chatter; deny serve *")
    talker = await make_node("/talker")
    shown = await make_node("/shown", OTHER_NODE)
    before = await shown.call(proxy.master, "getSystemState")
    for node in (talker, shown):
        await node.publish(proxy.master, "/odom")
    await talker.publish(proxy.master)
    await talker.serve(proxy.master)
    state = (await shown.call(proxy.master, "getSystemState"))[2]
    assert state == [
        [["/odom", ["/talker", "/shown"]], ["/chatter", ["/talker"]]],
        [],
        [["/add", ["/talker"]]],
    ]
    types = (await shown.call(proxy.master, "getTopicTypes"))[2]
    assert ["/chatter", "std_msgs/String"] in types
    outside = await rpc(master.uri, "getSystemState", "/x")
    assert outside[2] == [[["/odom", ["/talker", "/shown"]]], [], []]
    assert before[2] == [[], [], []]


async def test_a_dead_hidden_publisher_disappears_from_updates(make_proxy, make_node):
    proxy = await make_proxy(policy="deny publish /chatter")
    talker = await make_node("/talker")
    listener = await make_node("/listener", OTHER_NODE)
    await talker.publish(proxy.master)
    await listener.subscribe(proxy.master)
    await talker.stop()
    await until(lambda: listener.updates()[-1:] == [[]], "the subscriber gets the end")


# 2. What inside takes from outside


async def test_a_denied_subscription_gets_the_publishers_inside_alone(
    make_proxy, master, make_node
):
    proxy = await make_proxy(policy="deny subscribe /chatter")
    master.register("publishers", "/chatter", "/outside", OUTSIDE_PUBLISHER)
    listener = await make_node("/listener")
    talker = await make_node("/talker", OTHER_NODE)
    assert (await listener.subscribe(proxy.master))[2] == []
    assert master.holds("subscribers", "/chatter") == []
    await talker.publish(proxy.master)
    assert master.holds("publishers", "/chatter") == [OUTSIDE_PUBLISHER, proxy.uri(talker)]
    await until(lambda: listener.updates()[-1:] == [[talker.uri]], "the inside publisher")
    await rpc(proxy.uri(listener), "publisherUpdate", "/master", "/chatter", [OUTSIDE_PUBLISHER])
    assert listener.updates()[-1] == [talker.uri]


async def test_a_denied_service_of_outside_is_not_found(make_proxy, master, make_node):
    proxy = await make_proxy(policy="deny call *")
    client = await make_node("/client")
    server = await make_node("/server", OTHER_NODE)
    await server.serve(proxy.master)
    await rpc(master.uri, "registerService", "/far", "/far/add", "rosrpc://h:1", "http://h:2/")
    code, text, uri = await client.call(proxy.master, "lookupService", "/far/add")
    assert (code, uri) == (-1, "")
    assert text.startswith("no provider")
    assert "--policy: deny call *" in text
    assert (await client.call(proxy.master, "lookupService", "/add"))[2] == server.service_api


@pytest.fixture
async def params(make_proxy, master, node):
    """A proxy that denies some parameters."""
    master.params |= {"/secret/key": 1, "/secret": {"key": 1}, "/open": 2, "/other/x": 3}
    rules = "deny get-param /secret/*; deny set-param /secret/*; deny get-param */password"
    return await make_proxy(policy=rules)


@pytest.mark.parametrize(
    ("method", "given"),
    [
        ("getParam", ["/secret/key"]),
        ("getParam", ["secret//key"]),
        ("getParam", ["/secret"]),
        ("getParam", ["/"]),
        ("hasParam", ["/secret/key"]),
        ("searchParam", ["secret/key"]),
        ("subscribeParam", ["http://127.0.2.11:1/", "/secret/key"]),
        ("setParam", ["/secret/key", 7]),
        ("setParam", ["/secret/new", {"a": 1}]),
        ("setParam", ["/secret", 7]),
        ("setParam", ["/", {"secret": 1}]),
        ("deleteParam", ["/secret/key"]),
        ("deleteParam", ["/secret"]),
    ],
)
async def test_denied_parameters(params, node, master, method, given):
    code, text, _ = await node.call(params.master, method, *given)
    assert code == -1
    assert "--policy: deny" in text
    assert [call for call in master.named(method) if call[0] == node.name] == []
    assert master.params["/secret/key"] == 1


async def test_other_parameters_pass(params, node, master):
    assert (await node.call(params.master, "getParam", "/open"))[2] == 2
    assert (await node.call(params.master, "setParam", "/open", 5))[0] == 1
    assert (await node.call(params.master, "setParam", "/more", {"a": 5}))[0] == 1
    assert (await node.call(params.master, "getParamNames"))[2] == [
        "/more",
        "/open",
        "/other/x",
        "/secret",
    ]


async def test_a_long_call_is_judged_by_its_head(params, node, master):
    long = "x" * 200_000
    code, text, _ = await node.call(params.master, "setParam", "/secret/key", long)
    assert (code, "deny set-param /secret/*" in text) == (-1, True)
    assert (await node.call(params.master, "setParam", "/open", long))[0] == 1
    assert master.params["/open"] == long
    odd = xml("setParam", node.name, "/secret/key", long).replace(b"/secret", b"/secre&#116;")
    reply = await exchange(params.master, http_post(odd), node.address)
    assert reply.value[0] == -1
    assert master.params["/secret/key"] == 1


async def test_a_multicall_is_judged_call_by_call(params, node, master):
    calls = [
        {"methodName": "setParam", "params": [node.name, "/open", "x" * 100_000]},
        {"methodName": "setParam", "params": [node.name, "/secret/key", 7]},
        {"methodName": "getParam", "params": [node.name, "/other/x"]},
    ]
    first, second, third = await rpc(params.master, "system.multicall", calls, source=NODE)
    assert (first[0][0], second[0][0], third[0][2]) == (1, -1, 3)
    assert master.params["/secret/key"] == 1


async def test_a_multicall_of_many_parameters_asks_the_master_once(params, node, master):
    """A rule for names that end in something needs all names there are."""
    calls = [{"methodName": "getParam", "params": [node.name, "/open"]} for _ in range(100)]
    results = await rpc(params.master, "system.multicall", calls, source=NODE)
    assert [result[0][2] for result in results] == [2] * 100
    assert len(master.named("getParamNames")) == 1


# 3. From outside


async def test_a_denied_topic_is_refused_outside_and_served_to_neighbours(make_proxy, make_node):
    proxy = await make_proxy(policy="deny publish /chatter")
    talker = await make_node("/talker")
    other = await make_node("/other", OTHER_NODE)
    await talker.publish(proxy.master)
    await talker.publish(proxy.master, "/odom")
    await other.publish(proxy.master, "/else")
    for topic in ("/chatter", "chatter", "//chatter"):
        code, text, protocols = await rpc(proxy.uri(talker), "requestTopic", "/x", topic, TCPROS)
        assert (code, protocols) == (-1, [])
        assert "deny publish /chatter. Change that rule if the node may have this" in text
    header = await greet(proxy.lease(talker), topic_header("/chatter"))
    assert "policy of --policy: deny publish /chatter" in header["error"]
    assert (await greet(proxy.lease(talker), topic_header("/odom")))["callerid"] == "/talker"
    asked = (PROXY, proxy.endpoint(talker).port)
    reply = await rpc(asked, "requestTopic", "/other", "/chatter", TCPROS, source=OTHER_NODE)
    assert reply[0] == 1
    async with connect(asked, OTHER_NODE) as wire:
        await wire.send(topic_header("/chatter"))
        assert (await read_header(wire))["callerid"] == "/talker"


@pytest.mark.parametrize(
    "fields",
    [
        {"topic ": "/chatter"},
        {"topic": "/odom", " topic": "/chatter"},
        {"topic": "/chatter", " topic": "/odom"},
        {"topic": "/chatter", "service": "/other"},
        {"service ": "/secret"},
    ],
)
async def test_no_spelling_of_a_header_gets_around_a_rule(make_proxy, make_node, fields):
    proxy = await make_proxy(policy="deny publish /chatter; deny serve /secret")
    talker = await make_node("/talker")
    await talker.publish(proxy.master)
    await talker.publish(proxy.master, "/odom")
    header = encode_header({"callerid": "/outside", "md5sum": "*", "type": "*", **fields})
    assert (await greet(proxy.lease(talker), header))["error"]
    assert talker.headers == []


async def test_udpros_is_refused_where_topics_may_be_denied(make_proxy, make_node):
    """The UDPROS offer has its own topic field, which roscpp believes."""
    proxy = await make_proxy(policy="deny publish /chatter by /talker")
    talker = await make_node("/talker")
    other = await make_node("/other", OTHER_NODE)
    for node in (talker, other):
        await node.publish(proxy.master, "/odom")
    offer = [["UDPROS", Binary(b"topic=/chatter"), "h", 1, 1500]]
    reply = await rpc(proxy.uri(talker), "requestTopic", "/x", "/odom", offer)
    assert (reply[0], "only TCPROS" in reply[1]) == (-1, True)
    assert (await rpc(proxy.uri(other), "requestTopic", "/x", "/odom", offer))[0] == 1


async def test_a_uri_of_the_proxys_own_gets_around_no_rule(make_proxy, master, make_node):
    proxy = await make_proxy(policy="deny publish /chatter")
    talker = await make_node("/talker")
    await talker.publish(proxy.master, "/odom")
    own = proxy.uri(talker)
    relayed = f"http://{PROXY}:{proxy.endpoint(talker).port}/"
    for uri in (own, relayed):
        reply = await talker.call(proxy.master, "registerPublisher", "/chatter", "*", uri)
        assert (reply[0], "deny publish" in reply[1]) == (-1, True)
    assert master.holds("publishers", "/chatter") == []


async def test_a_denied_service_and_method_are_refused_outside(make_proxy, make_node):
    proxy = await make_proxy(policy="deny serve /add; deny slave getBus* by /spy")
    server = await make_node("/server")
    await server.serve(proxy.master)
    assert "deny serve /add" in (await greet(proxy.lease(server), service_header()))["error"]
    uri = proxy.uri(server)
    code, text, _ = await rpc(uri, "getBusInfo", "/spy")
    assert (code, "deny slave getBus* by /spy" in text) == (-1, True)
    assert (await rpc(uri, "getBusInfo", "/friend"))[0] == 1
    calls = [{"methodName": "getBusStats", "params": ["/spy"]}]
    assert (await rpc(uri, "system.multicall", calls))[0][0][0] == -1


async def test_the_masters_own_calls_pass(make_proxy, master, make_node):
    proxy = await make_proxy(policy="deny slave *")
    listener = await make_node("/listener")
    await listener.subscribe(proxy.master)
    await rpc(master.uri, "registerPublisher", "/far", "/chatter", "*", OUTSIDE_PUBLISHER)
    await until(lambda: listener.updates() == [[OUTSIDE_PUBLISHER]], "the master's update arrives")
    assert (await rpc(proxy.uri(listener), "shutdown", "/master", ""))[0] == -1


# 5. Changes


async def test_a_change_hides_cuts_and_shows(make_proxy, master, make_node):
    proxy = await make_proxy(**PATIENT)
    talker = await make_node("/talker")
    listener = await make_node("/listener", OTHER_NODE)
    await talker.publish(proxy.master)
    await talker.publish(proxy.master, "/odom")
    await listener.subscribe(proxy.master)
    async with connect(proxy.lease(talker)) as wire, connect(proxy.lease(talker)) as kept:
        await wire.send(topic_header())
        await read_header(wire)
        await kept.send(topic_header("/odom"))
        await read_header(kept)
        before = len(listener.updates())
        assert await told(proxy, "deny publish /chatter") == (1, 0, 1)
        assert await denied(proxy, "publish") == 2  # the registration and the connection
        assert await wire.outcome() in ("closed", "reset")
        assert master.holds("publishers", "/chatter") == []
        assert master.holds("publishers", "/odom") == [proxy.uri(talker)]
        await until(lambda: len(listener.updates()) > before, "the subscriber is told")
        assert all(talker.uri in update for update in listener.updates()[before:])
        calls = len(master.calls)
        assert await told(proxy, "deny publish /chatter") == (0, 0, 0)
        assert not [c for c in master.calls[calls:] if c[0].startswith(("reg", "unreg"))]
        assert await told(proxy) == (0, 1, 0)
        assert master.holds("publishers", "/chatter") == [proxy.uri(talker)]
        assert all(talker.uri in update for update in listener.updates()[before:])
        await kept.send(b"ping")
        assert await kept.exactly(4) == b"ping"


async def test_a_subscription_that_is_denied_later_loses_outside(make_proxy, master, make_node):
    proxy = await make_proxy()
    master.register("publishers", "/chatter", "/outside", OUTSIDE_PUBLISHER)
    listener = await make_node("/listener")
    assert (await listener.subscribe(proxy.master))[2] == [OUTSIDE_PUBLISHER]
    assert await told(proxy, "deny subscribe *") == (1, 0, 0)
    assert master.holds("subscribers", "/chatter") == []
    assert listener.updates()[-1] == []
    assert await told(proxy) == (0, 1, 0)
    assert listener.updates()[-1] == [OUTSIDE_PUBLISHER]


async def test_a_change_while_the_master_is_away_is_made_up_for(make_proxy, master, make_node):
    proxy = await make_proxy(**PATIENT)
    talker = await make_node("/talker")
    await talker.publish(proxy.master)
    await master.stop()
    layer = '{"layers": [{"name": "a", "rules": ["deny publish *"]}]}'
    assert (await post(proxy, "/policy", layer)).status == 503
    await master.start()
    await until(lambda: not master.holds("publishers", "/chatter"), "the topic is unregistered")


async def test_the_file_is_read_again(make_proxy, master, make_node, tmp_path):
    file = tmp_path / "rules"
    file.write_text("# nothing yet\n")
    proxy = await make_proxy(policy_file=str(file))
    talker = await make_node("/talker")
    await talker.publish(proxy.master)
    file.write_text("deny publish /chatter\n")
    await until(lambda: not master.holds("publishers", "/chatter"), "the file is read again")
    file.write_text("deny everything\n")
    problems = proxy.ros1.context.problems.all
    await until(lambda: "--policy-file" in [p.subject for p in problems()], "a problem")
    assert master.holds("publishers", "/chatter") == []
    file.write_text("allow publish *\n")
    await until(lambda: master.holds("publishers", "/chatter"), "registered again")
    assert "--policy-file" not in [p.subject for p in problems()]


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ('{"layers": [{"name": "web", "rules": ["deny publsh *"]}]}', b"layer 'web': rule 'deny"),
        ('{"layers": [{"name": "web"}]}', b"rules"),
        ("{}", b"layers"),
    ],
)
async def test_a_bad_policy_names_what_is_wrong(proxy, body, says):
    reply = await post(proxy, "/policy", body)
    assert reply.status == 400
    assert says in reply.body
    assert proxy.ros1.context.policy.rules.layers == ()


# 6. Restarts


async def test_a_restarted_proxy_knows_what_is_hidden(make_proxy, master, make_node):
    proxy = await make_proxy(policy="deny publish /chatter; deny subscribe /far", **PATIENT)
    talker = await make_node("/talker")
    listener = await make_node("/listener", OTHER_NODE)
    for node in (talker, listener):
        await node.publish(proxy.master, "/rosout")
    await talker.publish(proxy.master)
    await listener.subscribe(proxy.master)
    await listener.subscribe(proxy.master, "/far")
    await proxy.restart()
    late = await make_node("/late", THIRD_NODE)

    async def finds() -> bool:
        return (await late.subscribe(proxy.master))[2] == [talker.uri]

    await until(finds, "hidden publishers are known again")
    await until(lambda: len(proxy.app.status()["policy"]["hidden"]) == 2, "the subscriber, too")
    assert master.holds("publishers", "/chatter") == []
    assert master.holds("subscribers", "/far") == []


async def test_nothing_is_registered_before_an_operator_has_told_its_policy(
    make_proxy, master, make_node
):
    """Neither by nodes that call nor by the recovery."""
    proxy = await make_proxy(await_policy=60, **PATIENT)
    assert await told(proxy) == (0, 0, 0)
    talker = await make_node("/talker")
    late = await make_node("/late", OTHER_NODE)
    await talker.publish(proxy.master, "/rosout")
    assert await told(proxy, "deny publish /chatter") == (0, 0, 0)
    await talker.publish(proxy.master)
    master.calls.clear()
    await proxy.restart()
    registering = asyncio.create_task(late.publish(proxy.master))
    await until(lambda: "getPid" in dict(master.calls), "the proxy finds the master")
    assert not {"getSystemState", "registerPublisher"} & {*dict(master.calls)}
    assert not registering.done()
    await told(proxy, "deny publish /chatter")
    assert (await registering)[0] == 1
    await until(lambda: len(proxy.app.status()["policy"]["hidden"]) == 2, "both are hidden")
    assert master.holds("publishers", "/chatter") == []


async def test_an_operator_is_waited_for_once_and_not_for_ever(make_proxy, make_node):
    proxy = await make_proxy(await_policy=0.2)
    talker = await make_node("/talker")
    assert (await talker.publish(proxy.master))[0] == 1


async def test_a_restarted_proxy_asks_nodes_for_hidden_services(make_proxy, make_node):
    proxy = await make_proxy(policy="deny serve *", **PATIENT)
    server = await make_node("/server")
    client = await make_node("/client", OTHER_NODE)

    async def answer(node, reader, writer, header):
        if header.get("service") == "/add":
            await echo(node, reader, writer, header)
        else:
            writer.write(encode_header({"error": "no such service"}))

    server.stream = answer
    await server.publish(proxy.master, "/rosout")
    await server.serve(proxy.master)
    await proxy.restart()

    async def finds():
        return (await client.call(proxy.master, "lookupService", "/add"))[2] == server.service_api

    assert (await client.call(proxy.master, "lookupService", "/sub"))[0] == -1
    await until(finds, "the service is found again")
    assert (await greet(proxy.lease(server), service_header()))["error"]


async def test_a_restart_with_stricter_rules_takes_back(make_proxy, master, make_node):
    proxy = await make_proxy(**PATIENT)
    talker = await make_node("/talker")
    for topic in ("/rosout", "/chatter"):
        await talker.publish(proxy.master, topic)
    await talker.serve(proxy.master)
    uri = proxy.uri(talker)
    options = {name: getattr(proxy.settings, name) for name in ("master_port",)}
    ports = proxy.settings.ports.listen
    await proxy.stop()
    await make_proxy(
        policy="deny publish /chatter; deny serve *", port_range=str(ports), **options, **PATIENT
    )
    await until(lambda: not master.holds("publishers", "/chatter"), "the topic is taken back")
    await until(lambda: not master.holds("services", "/add"), "the service is taken back")
    assert master.holds("publishers", "/rosout") == [uri]


async def test_a_restarted_master_is_not_told(make_proxy, master, make_node):
    proxy = await make_proxy(policy="deny publish /chatter")
    talker = await make_node("/talker")
    await talker.publish(proxy.master, "/odom")
    await talker.publish(proxy.master)
    await master.restart()
    await until(lambda: master.holds("publishers", "/odom"), "the rest is registered again")
    await looks(master, 8)
    assert master.holds("publishers", "/chatter") == []


# 7. Audit, and what is told


async def test_audit_only_tells(make_proxy, master, make_node, caplog):
    proxy = await make_proxy(
        policy="deny publish *; deny slave *; deny get-param *", policy_mode="audit"
    )
    talker = await make_node("/talker")
    await talker.publish(proxy.master)
    assert master.holds("publishers", "/chatter") == [proxy.uri(talker)]
    assert (await rpc(proxy.uri(talker), "requestTopic", "/x", "/chatter", TCPROS))[0] == 1
    assert (await greet(proxy.lease(talker), topic_header()))["callerid"] == "/talker"
    assert (await talker.call(proxy.master, "getParam", "/x"))[1] == "not set"
    assert await denied(proxy, "publish", "audit") >= 3
    assert await denied(proxy, "get-param", "audit") == 1
    assert await denied(proxy, "publish") == 0
    assert "publish /chatter of /talker would be denied by policy of --policy: deny" in caplog.text


async def test_an_audit_rule_tells_of_what_was_registered_before(make_proxy, make_node):
    proxy = await make_proxy()
    talker = await make_node("/talker")
    await talker.publish(proxy.master)
    assert await told(proxy, "deny publish *", mode="audit") == (0, 0, 0)
    assert await denied(proxy, "publish", "audit") == 1
    assert await denied(proxy, "publish") == 0


async def test_the_status_tells_layers_and_hidden_names(make_proxy, make_node):
    proxy = await make_proxy(policy="deny publish /chatter")
    talker = await make_node("/talker")
    await talker.publish(proxy.master)
    policy = json.loads(json.dumps(proxy.app.status()))["policy"]
    assert policy["layers"] == [
        {
            "name": "--policy",
            "mode": "enforce",
            "rules": ["deny publish /chatter"],
            "addresses": None,
            "left_out": 0,
        }
    ]
    assert policy["hidden"] == [
        {
            "kind": "publish",
            "name": "/chatter",
            "node": "/talker",
            "reason": "policy of --policy: deny publish /chatter",
            "address": talker.address,
        }
    ]
