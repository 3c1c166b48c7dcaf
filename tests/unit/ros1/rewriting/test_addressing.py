"""The address of a node for each caller: tables of import and export."""

import pytest

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import NodeLocation
from rosproxy.ros1.rewriting.addressing import Addressing
from rosproxy.shared.addresses import HostPort
from tests.unit.builders import PROXY, add_node, add_registration, make_addressing, make_caller

LITERAL = "http://10.0.0.5:40001/"
OUTSIDE = "http://robot-host:45000/"
RELAYED = f"http://{PROXY}:45000/"

NEIGHBOUR = make_caller("10.0.0.6")
STRANGER = make_caller("172.20.0.9")  # inside, in a network from which the node can't be reached


@pytest.mark.parametrize(
    ("uri", "address"),
    [
        (LITERAL, None),
        ("http://c5:40001/", "10.0.0.5"),
        ("http://localhost:40001/", "10.0.0.5"),
        ("http://127.0.0.1:40001/", "10.0.0.5"),
        ("http://[fd00::5]:40001/", None),
        ("http://c5:40001/", "fd00::5"),
        ("http://10.0.0.5:40001", None),
        ("http://10.0.0.5:40001/of/another/proxy/", None),
    ],
)
def test_an_advertised_uri_tells_the_port_alone(uri: str, address: str | None) -> None:
    """Some client libraries take a path for a malformed URI, or for a port."""
    addressing = make_addressing()
    endpoint = add_node(addressing, uri, address)
    assert addressing.advertised_uri(endpoint) == OUTSIDE
    assert addressing.advertised_service(endpoint) == "rosrpc://robot-host:45000"
    assert addressing.lease_of(OUTSIDE) == 45000
    assert addressing.endpoint_of(OUTSIDE) is endpoint
    assert addressing.export_slave(uri, make_caller(endpoint.location.address)) == OUTSIDE


@pytest.mark.parametrize(
    ("path", "stands"),
    [
        ("/", True),
        ("", True),
        ("/RPC2", True),
        ("/10.0.0.5:40001/", True),  # as former versions advertised it
        ("/10.0.0.5:40009/", False),  # a former node of the port
        ("/c5:40001/10.0.0.6/", False),
    ],
)
def test_a_uri_of_a_former_version_means_the_node_that_it_names(path: str, stands: bool) -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    resolved = addressing.endpoint_of(f"http://robot-host:45000{path}")
    assert resolved is (endpoint if stands else None)


def test_advertised_ports_have_an_offset() -> None:
    addressing = make_addressing(advertise=(30000, 30009))
    endpoint = add_node(addressing)
    outside = "http://robot-host:30000/"
    assert addressing.outside(45009) == HostPort("robot-host", 30009)
    assert addressing.advertised_uri(endpoint) == outside
    assert addressing.import_slave(outside, STRANGER) == RELAYED
    assert addressing.export_slave(RELAYED, STRANGER) == outside
    assert addressing.import_slave(OUTSIDE, STRANGER) == OUTSIDE  # the port is not advertised
    assert addressing.lease_of(OUTSIDE) is None


def test_an_advertised_ipv6_host_has_brackets() -> None:
    addressing = make_addressing(host="fd00::1", networks=["fd01::/64"])
    endpoint = add_node(addressing, "http://[fd01::5]:40001/")
    outside = "http://[fd00::1]:45000/"
    assert addressing.advertised_uri(endpoint) == outside
    assert addressing.advertised_service(endpoint) == "rosrpc://[fd00::1]:45000"
    assert addressing.import_slave(outside, make_caller("fd01::6")) == "http://[fd01::5]:40001/"
    far = make_caller("fd02::6", proxy="fd02::1")
    relayed = "http://[fd02::1]:45000/"
    assert addressing.import_slave(outside, far) == relayed
    assert addressing.export_slave(relayed, far) == outside


IMPORTS = [
    # caller, URI and host name of a node, the URI that the caller gets
    ("the node itself", make_caller("10.0.0.5"), LITERAL, None, LITERAL),
    ("a neighbour", NEIGHBOUR, LITERAL, None, LITERAL),
    ("a stranger", STRANGER, LITERAL, None, RELAYED),
    ("another family", make_caller("fd00::6", proxy="fd00::1"), LITERAL, None, None),
    (
        "the node, by an unresolvable name",
        make_caller("10.0.0.5"),
        "http://c5:40001/",
        "10.0.0.5",
        "",
    ),
    ("a neighbour, same", NEIGHBOUR, "http://c5:40001/", "10.0.0.5", None),
    ("a stranger, same", STRANGER, "http://c5:40001/", "10.0.0.5", None),
    ("the node, by loopback", make_caller("10.0.0.5"), "http://127.0.0.1:40001/", "10.0.0.5", ""),
    ("a neighbour, same", NEIGHBOUR, "http://127.0.0.1:40001/", "10.0.0.5", None),
]


@pytest.mark.parametrize(("caller", "uri", "address", "given"), [row[1:] for row in IMPORTS])
def test_what_a_caller_is_given(caller, uri: str, address: str | None, given: str | None) -> None:
    """None stands for the relayed form, an empty text for the node's own."""
    addressing = make_addressing()
    endpoint = add_node(addressing, uri, address)
    outside = addressing.advertised_uri(endpoint)
    relayed = outside.replace("robot-host", str(HostPort(caller.proxy, 1))[:-2])
    expected = {None: relayed, "": uri}.get(given, given)
    assert addressing.import_slave(outside, caller) == expected
    assert addressing.export_slave(str(expected), caller) == outside


def test_a_name_that_leads_to_the_node_is_given_to_neighbours() -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing, "http://c5:40001/", "10.0.0.5", named=True)
    outside = addressing.advertised_uri(endpoint)
    assert addressing.import_slave(outside, NEIGHBOUR) == "http://c5:40001/"
    assert addressing.import_slave(outside, STRANGER) == RELAYED


@pytest.mark.parametrize(
    ("caller_address", "node_address", "networks", "neighbours"),
    [
        ("10.0.0.6", "10.0.0.5", ["10.0.0.0/24"], True),
        ("10.0.1.6", "10.0.0.5", ["10.0.0.0/24"], False),
        ("10.0.1.6", "10.0.0.5", ["10.0.0.0/24", "10.0.1.0/24"], False),
        ("10.0.1.6", "10.0.0.5", ["10.0.0.0/24", "10.0.0.0/16"], True),
        ("10.0.0.6", "10.0.0.5", [], False),
        ("10.0.0.6", "10.0.0.5", ["fd00::/8"], False),
        ("fd00::6", "10.0.0.5", ["fd00::/8", "10.0.0.0/8"], False),
    ],
)
def test_neighbours_share_a_network(
    caller_address: str, node_address: str, networks: list[str], neighbours: bool
) -> None:
    addressing = make_addressing(networks=networks)
    uri = f"http://{node_address}:40001/"
    outside = addressing.advertised_uri(add_node(addressing, uri))
    assert (addressing.import_slave(outside, make_caller(caller_address)) == uri) is neighbours


UNTOUCHED = [
    "http://laptop:33445/",
    "http://robot-host:11311/",
    "http://robot-host:45001/10.0.0.5:40001/",  # another port of the proxy, without an endpoint
    "http://robot-host:45000/10.0.0.5:40009/",  # a former node of the port
    "http://ROBOT-HOST:45000/10.0.0.5:40001/",
    "https://robot-host:45000/10.0.0.5:40001/",
    "rosrpc://robot-host:45000",
    "http://robot-host:45010/10.0.0.5:40001/",
    "",
    "no URI",
    "http://[::1/",
]


@pytest.mark.parametrize("uri", UNTOUCHED)
def test_what_is_no_endpoint_of_ours_is_imported_and_exported_as_it_is(uri: str) -> None:
    addressing = make_addressing()
    add_node(addressing)
    for caller in (NEIGHBOUR, STRANGER):
        assert addressing.import_slave(uri, caller) == uri
        assert addressing.export_slave(uri, caller) == uri


def two_with_the_same_uri() -> tuple[Addressing, str, str]:
    addressing = make_addressing()
    uri = "http://node:40001/"
    first = add_node(addressing, uri, "10.0.0.5")
    second = add_node(addressing, uri, "10.0.0.6")
    return addressing, addressing.advertised_uri(first), addressing.advertised_uri(second)


@pytest.mark.parametrize(
    ("caller", "first", "second"),
    [
        ("10.0.0.5", "http://node:40001/", f"http://{PROXY}:45001/"),
        ("10.0.0.6", f"http://{PROXY}:45000/", "http://node:40001/"),
        (
            "10.0.0.7",
            f"http://{PROXY}:45000/",
            f"http://{PROXY}:45001/",
        ),
    ],
)
def test_two_containers_with_the_same_uri_each_mean_their_own(
    caller: str, first: str, second: str
) -> None:
    addressing, first_advertised, second_advertised = two_with_the_same_uri()
    who = make_caller(caller)
    assert [addressing.import_slave(uri, who) for uri in (first_advertised, second_advertised)] == [
        first,
        second,
    ]
    assert [addressing.export_slave(uri, who) for uri in (first, second)] == [
        first_advertised,
        second_advertised,
    ]


def test_a_uri_that_a_caller_would_take_for_its_own_is_not_given_to_it() -> None:
    """A neighbour's URI that reads like the caller's own led the caller to itself."""
    addressing = make_addressing()
    uri = "http://node:40001/"
    resolvable = add_node(addressing, uri, "10.0.0.5", named=True)
    add_node(addressing, uri, "10.0.0.6")
    outside = addressing.advertised_uri(resolvable)
    caller = make_caller("10.0.0.6")
    given = addressing.import_slave(outside, caller)
    assert given == f"http://{PROXY}:45000/"
    assert addressing.export_slave(given, caller) == outside


def test_a_node_behind_source_nat_means_itself_by_its_uri() -> None:
    """The node registers from the gateway's address, and the proxy finds the node's own address."""
    addressing = make_addressing()
    uri = "http://node:40001/"
    add_node(addressing, uri, "10.0.0.6")
    node = HostPort("node", 40001)
    place = add_node(addressing, uri, "10.0.0.5", confirmed=False).location
    endpoint = addressing.registry.admit(uri, node, place, "10.0.0.254")
    exported = addressing.export_slave(uri, make_caller("10.0.0.254"))
    assert exported == addressing.advertised_uri(endpoint)


def test_a_node_that_has_moved_is_relayed_for_every_other_caller() -> None:
    """Callers on the node's own machine, too. Only the node itself gets its own URI."""
    addressing = make_addressing()
    endpoint = add_node(addressing)
    addressing.registry.move({endpoint: NodeLocation("10.0.0.9", named=False, stale=True)})
    outside = "http://robot-host:45000/"
    assert addressing.advertised_uri(endpoint) == outside
    relayed = f"http://{PROXY}:45000/"
    for caller in (NEIGHBOUR, make_caller("10.0.0.9"), make_caller("10.0.0.5"), STRANGER):
        assert addressing.import_slave(outside, caller) == relayed
    assert addressing.import_slave(outside, make_caller("10.0.0.9", endpoint=endpoint)) == LITERAL
    assert addressing.export_slave(LITERAL, make_caller("10.0.0.9")) == outside


def test_uris_of_a_removed_endpoint_mean_the_same_until_another_node_has_the_port() -> None:
    """Otherwise no tool inside can unregister the endpoint by its literal URI."""
    addressing = make_addressing(listen=(45000, 45000))
    endpoint = add_node(addressing)
    addressing.registry.remove(endpoint)
    for caller in (NEIGHBOUR, STRANGER):
        assert addressing.export_slave(LITERAL, caller) == OUTSIDE
        assert addressing.export_slave(RELAYED, caller) == OUTSIDE
        assert addressing.import_slave(OUTSIDE, caller) == OUTSIDE
        assert addressing.export_slave(OUTSIDE, caller) == OUTSIDE
    add_node(addressing, "http://10.0.0.7:40001/")
    assert addressing.export_slave(LITERAL, NEIGHBOUR) == LITERAL
    assert addressing.import_slave(OUTSIDE, NEIGHBOUR) == "http://10.0.0.7:40001/"


@pytest.mark.parametrize(
    ("uri", "handed_out"),
    [
        (OUTSIDE, True),
        (RELAYED, True),
        (f"http://{PROXY}:45007/", True),
        (LITERAL, False),
        ("http://laptop:33445/", False),
        ("http://robot-host:45001/10.0.0.5:40001/", False),
        (f"http://{PROXY}:11311/", False),
        ("no URI", False),
    ],
)
def test_uris_that_the_proxy_handed_out(uri: str, handed_out: bool) -> None:
    addressing = make_addressing()
    add_node(addressing)
    assert addressing.is_own_uri(uri, STRANGER) is handed_out


SERVICES = [
    # caller, the URI that the caller gets
    (make_caller("10.0.0.5"), "rosrpc://10.0.0.5:50001"),
    (NEIGHBOUR, "rosrpc://10.0.0.5:50001"),
    (STRANGER, f"rosrpc://{PROXY}:45000"),
]


@pytest.mark.parametrize(("caller", "given"), SERVICES)
def test_a_service_is_imported_and_exported(caller, given: str) -> None:
    addressing = make_addressing()
    add_registration(addressing, add_node(addressing), Kind.SERVICE, "/s")
    outside = "rosrpc://robot-host:45000"
    assert addressing.import_service(outside, "/s", caller) == given
    assert addressing.export_service(given, "/s", caller) == outside


@pytest.mark.parametrize("caller", [caller for caller, _ in SERVICES])
def test_a_service_that_was_rebuilt_from_the_master(caller) -> None:
    """The proxy does not know the service's own URI before the node has answered."""
    addressing = make_addressing()
    endpoint = add_node(addressing)
    registration = add_registration(addressing, endpoint, Kind.SERVICE, "/s")
    object.__setattr__(registration, "service_api", None)
    outside = "rosrpc://robot-host:45000"
    assert addressing.import_service(outside, "/s", caller) == f"rosrpc://{PROXY}:45000"
    addressing.registry.note_service_port(endpoint, "/s", 50001)
    given = addressing.import_service(outside, "/s", caller)
    assert given == dict(SERVICES)[caller]
    assert addressing.export_service(given, "/s", caller) == outside


def test_a_service_that_is_not_known_is_relayed() -> None:
    """The proxy must not guess the node's TCPROS port: the proxy could not export such a URI."""
    addressing = make_addressing()
    add_node(addressing).topic_ports["/a"] = 50001
    given = addressing.import_service("rosrpc://robot-host:45000", "/s", NEIGHBOUR)
    assert given == f"rosrpc://{PROXY}:45000"
    assert addressing.export_service(given, "/s", NEIGHBOUR) == "rosrpc://robot-host:45000"


@pytest.mark.parametrize(
    "uri",
    ["rosrpc://laptop:5", "rosrpc://robot-host:45001", "rosrpc://robot-host:5", "http://a:1/", ""],
)
def test_other_services_are_left_as_they_are(uri: str) -> None:
    addressing = make_addressing()
    add_registration(addressing, add_node(addressing), Kind.SERVICE, "/s")
    for name in ("/s", "/t"):
        assert addressing.import_service(uri, name, NEIGHBOUR) == uri
        assert addressing.export_service(uri, name, NEIGHBOUR) == uri
