"""The demo's master answers as ROS's own master does."""

import http.client
import queue
import xmlrpc.client

import pytest

from rosproxy.demo.boundary import Boundary
from rosproxy.demo.master import Master
from rosproxy.demo.rpc import RpcServer, call

FREE = Boundary()
A, B = "http://a:1/", "http://b:2/"


@pytest.fixture
def master():
    running = Master("127.0.0.1", FREE)
    yield running
    running.close()


@pytest.fixture
def ask(master):
    return lambda method, *args: call(FREE, master.uri, method, *args)


class Slave:
    """A node's XML-RPC side that notes what it is called with."""

    def __init__(self):
        self.calls: queue.Queue[tuple] = queue.Queue()
        self._server = RpcServer("127.0.0.1", self._note, FREE)
        self.uri = f"http://127.0.0.1:{self._server.port}/"
        self._server.start()

    def _note(self, method, params):
        self.calls.put((method, *params))
        return 1, "", 0

    def next_call(self):
        return self.calls.get(timeout=5)

    def close(self):
        self._server.close()


@pytest.fixture
def slave():
    running = Slave()
    yield running
    running.close()


def test_publishers_and_subscribers_find_each_other(ask):
    topic = ("/t", "std_msgs/String")
    assert ask("registerSubscriber", "/sub", *topic, A) == [1, "Subscribed to [/t]", []]
    assert ask("registerPublisher", "/pub", *topic, B)[2] == [A]
    assert ask("registerSubscriber", "/sub", *topic, A)[2] == [B]
    state = ask("getSystemState", "/x")[2]
    assert state == [[["/t", ["/pub"]]], [["/t", ["/sub"]]], []]
    assert ask("getTopicTypes", "/x")[2] == [["/t", "std_msgs/String"]]


def test_subscribers_hear_of_every_registration_and_of_the_end(ask, slave):
    ask("registerSubscriber", "/sub", "/t", "*", slave.uri)
    ask("registerPublisher", "/pub", "/t", "std_msgs/String", A)
    ask("registerPublisher", "/pub", "/t", "std_msgs/String", A)
    ask("unregisterPublisher", "/pub", "/t", A)
    expected = ("publisherUpdate", "/master", "/t")
    assert [slave.next_call() for _ in range(3)] == [
        (*expected, [A]),
        (*expected, [A]),
        (*expected, []),
    ]


def test_a_second_node_of_the_same_name_shuts_the_first_one_down(ask, slave):
    ask("registerPublisher", "/twin", "/t", "std_msgs/String", slave.uri)
    ask("registerService", "/twin", "/s", "rosrpc://old:1", slave.uri)
    ask("registerSubscriber", "/twin", "/u", "std_msgs/String", B)
    reason = "[/twin] Reason: new node registered with same name"
    assert slave.next_call() == ("shutdown", "/master", reason)
    assert ask("getSystemState", "/x")[2] == [[], [["/u", ["/twin"]]], []]
    assert ask("lookupNode", "/x", "/twin")[2] == B


def test_unregistering_takes_exactly_what_was_registered(ask):
    ask("registerPublisher", "/pub", "/t", "std_msgs/String", A)
    answer = ask("unregisterPublisher", "/pub", "/t", B)
    assert answer == [1, "[/pub] is not a known provider of [/t]", 0]
    assert ask("unregisterPublisher", "/pub", "/t", A)[2] == 1
    assert ask("lookupNode", "/x", "/pub") == [-1, "unknown node [/pub]", ""]
    assert ask("unregisterPublisher", "/pub", "/t", A)[1] == "[/pub] is not a registered node"


def test_the_last_provider_of_a_service_wins(ask):
    assert ask("lookupService", "/x", "/s") == [-1, "no provider", ""]
    ask("registerService", "/a", "/s", "rosrpc://a:9", A)
    ask("registerService", "/b", "/s", "rosrpc://b:9", B)
    assert ask("lookupService", "/x", "s")[2] == "rosrpc://b:9"
    assert ask("unregisterService", "/a", "/s", "rosrpc://a:9")[2] == 0
    assert ask("unregisterService", "/b", "/s", "rosrpc://b:9")[2] == 1
    assert ask("lookupService", "/x", "/s")[0] == -1


def test_publishers_decide_on_a_topic_s_type(ask):
    ask("registerSubscriber", "/sub", "/t", "*", A)
    assert ask("getTopicTypes", "/x")[2] == []
    ask("registerSubscriber", "/sub", "/t", "std_msgs/Int32", A)
    ask("registerPublisher", "/pub", "/t", "std_msgs/String", B)
    ask("registerPublisher", "/pub", "/ns/u", "std_msgs/Bool", B)
    assert ask("getPublishedTopics", "/x", "")[2] == [
        ["/t", "std_msgs/String"],
        ["/ns/u", "std_msgs/Bool"],
    ]
    assert ask("getPublishedTopics", "/x", "/ns")[2] == [["/ns/u", "std_msgs/Bool"]]


def test_names_are_resolved_as_the_caller_means_them(ask):
    ask("registerPublisher", "/ns/node", "rel", "std_msgs/String", A)
    ask("registerPublisher", "/ns/node", "~own", "std_msgs/String", A)
    ask("registerPublisher", "/ns/node", "//abs//olute/", "std_msgs/String", A)
    topics = [topic for topic, _ in ask("getPublishedTopics", "/x", "")[2]]
    assert topics == ["/ns/rel", "/ns/node/own", "/abs/olute"]


def test_parameters_keep_their_types(ask):
    values = {
        "int": 1,
        "float": 1.5,
        "bool": True,
        "empty": "",
        "list": [1, [2.0, "x"]],
        "bytes": xmlrpc.client.Binary(b"\0\xff"),
        "tree": {"deep": {"leaf": 1}},
    }
    for name, value in values.items():
        assert ask("setParam", "/x", f"/p/{name}", value) == [1, f"parameter /p/{name} set", 0]
    assert ask("getParam", "/x", "/p")[2] == values
    assert ask("getParam", "/x", "/p/tree/deep/leaf")[2] == 1
    assert "/p/tree/deep/leaf" in ask("getParamNames", "/x")[2]
    assert ask("hasParam", "/x", "/p/bool") == [1, "/p/bool", True]


def test_parameters_that_are_not_there(ask):
    assert ask("getParam", "/x", "/no") == [-1, "Parameter [/no] is not set", 0]
    assert ask("deleteParam", "/x", "/no") == [-1, "parameter [/no] is not set", 0]
    assert ask("deleteParam", "/x", "/")[0] == -1
    assert ask("setParam", "/x", "/", 1)[0] == -1
    ask("setParam", "/x", "/a/b", 1)
    assert ask("getParam", "/x", "/a/b/c")[0] == -1
    ask("deleteParam", "/x", "/a/b")
    assert ask("getParam", "/x", "/a")[2] == {}


def test_parameters_are_searched_upwards(ask):
    ask("setParam", "/x", "/ns/gain", 1)
    ask("setParam", "/x", "/gain", 2)
    assert ask("searchParam", "/ns/sub/node", "gain")[2] == "/ns/gain"
    assert ask("searchParam", "/other", "gain")[2] == "/gain"
    assert ask("searchParam", "/other", "nothing")[0] == -1
    assert ask("searchParam", "/other", "~private")[0] == -1


def test_parameter_subscribers_hear_of_changes(ask, slave):
    assert ask("subscribeParam", "/sub", slave.uri, "/robot")[2] == {}
    ask("setParam", "/other", "/robot/speed", 3)
    ask("setParam", "/sub", "/robot/speed", 4)
    ask("deleteParam", "/other", "/robot/speed")
    ask("setParam", "/other", "/", {"robot": {"speed": 5}})
    ask("unsubscribeParam", "/sub", slave.uri, "/robot")
    ask("setParam", "/other", "/robot/speed", 6)
    ask("subscribeParam", "/sub", slave.uri, "/end")
    ask("setParam", "/other", "/end", 1)
    assert [slave.next_call()[2:] for _ in range(4)] == [
        ("/robot/speed/", 3),
        ("/robot/speed/", {}),
        ("/robot/", {"speed": 5}),
        ("/end/", 1),
    ]


@pytest.mark.parametrize(
    ("method", "args", "failure"),
    [
        ("registerPublisher", (), []),
        ("registerPublisher", ("/n", "/t"), []),
        ("registerPublisher", ("/n", "/t", "notype", A), []),
        ("registerPublisher", ("/n", "/t", "std_msgs/String", "ftp://x"), []),
        ("registerSubscriber", ("/n", "/", "std_msgs/String", A), []),
        ("registerService", ("/n", "http://s", "rosrpc://x:1", A), 0),
        ("lookupNode", ("/n", 7), ""),
        ("lookupService", (7, "/s"), ""),
        ("getSystemState", ("/n", "extra"), [[], [], []]),
        ("setParam", ("/n", "", 1), 0),
        ("subscribeParam", ("/n", "", "/k"), {}),
    ],
)
def test_wrong_calls_get_a_ros_error(ask, method, args, failure):
    code, message, value = ask(method, *args)
    assert (code, value) == (-1, failure)
    assert message


def test_unknown_methods_get_a_fault(ask):
    for method in ("nonsense", "_dispatch", "close", "system.listMethods.x"):
        with pytest.raises(xmlrpc.client.Fault, match="not supported"):
            ask(method, "/x")


def test_multicall_gives_every_call_its_own_answer(ask, master):
    calls = [
        {"methodName": "getUri", "params": ["/x"]},
        {"methodName": "nonsense", "params": []},
        {"methodName": "getPid", "params": ["/x"]},
    ]
    uri, fault, pid = ask("system.multicall", calls)
    assert uri == [[1, "", master.uri]]
    assert "faultString" in fault
    assert pid[0][0] == 1


def test_it_answers_at_both_paths_and_nowhere_else(master):
    host = master.uri.split("/")[2]
    body = xmlrpc.client.dumps(("/x",), "getPid")
    status = {}
    for path in ("/", "/RPC2", "/other"):
        connection = http.client.HTTPConnection(host, timeout=5)
        connection.request("POST", path, body, {"Content-Type": "text/xml"})
        response = connection.getresponse()
        response.read()
        status[path] = response.status
        connection.close()
    assert status == {"/": 200, "/RPC2": 200, "/other": 404}


def test_a_node_that_is_gone_delays_nobody(ask, slave):
    ask("registerSubscriber", "/gone", "/t", "*", "http://127.0.0.1:1/")
    ask("registerSubscriber", "/here", "/t", "*", slave.uri)
    ask("registerPublisher", "/pub", "/t", "std_msgs/String", A)
    assert slave.next_call()[3] == [A]
