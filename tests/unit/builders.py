"""Documents in the form of rospy and XmlRpc++, and small worlds for rewriting."""

import xmlrpc.client
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from ipaddress import ip_network
from typing import Any
from xml.sax.saxutils import escape

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.xmlrpc.values import Edit
from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation, Registration
from rosproxy.ros1.registry.registry import Registry
from rosproxy.ros1.registry.stand_ins import StandIns
from rosproxy.ros1.rewriting import master_api, master_calls
from rosproxy.ros1.rewriting.addressing import Addressing, Caller
from rosproxy.ros1.rewriting.master_calls import (
    CallOutcome,
    CallResult,
    MasterCall,
    Passing,
    RegistryChange,
    refusal,
)
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortMap, PortRange
from rosproxy.shared.settings import Settings
from rosproxy.shared.uris import parse_slave_uri, slave_uri

HOST = "robot-host"
PROXY = "10.0.0.1"
MASTER = f"{PROXY}:11311"


def py_call(method: str, *params: Any) -> bytes:
    """A call in the form of rospy and the tools."""
    return xmlrpc.client.dumps(params, method).encode()


def py_reply(value: Any) -> bytes:
    """A reply in the form of rosmaster and rospy."""
    return xmlrpc.client.dumps((value,), methodresponse=True).encode()


def cpp_value(value: Any) -> str:
    """XmlRpcValue::toXml: untyped strings, <i4>, no white space."""
    if isinstance(value, bool):
        return f"<value><boolean>{value:d}</boolean></value>"
    if isinstance(value, int):
        return f"<value><i4>{value}</i4></value>"
    if isinstance(value, float):
        return f"<value><double>{value!r}</double></value>"
    if isinstance(value, str):
        text = escape(value, {"'": "&apos;", '"': "&quot;"})
        return f"<value>{text}</value>"
    if isinstance(value, list | tuple):
        items = "".join(map(cpp_value, value))
        return f"<value><array><data>{items}</data></array></value>"
    members = (f"<member><name>{name}</name>{cpp_value(v)}</member>" for name, v in value.items())
    return f"<value><struct>{''.join(members)}</struct></value>"


def cpp_call(method: str, *params: Any) -> bytes:
    """A call in the form of roscpp (XmlRpcClient::generateRequest)."""
    inside = "".join(f"<param>{cpp_value(param)}</param>" for param in params)
    return (
        f'<?xml version="1.0"?>\r\n<methodCall><methodName>{method}</methodName>\r\n'
        f"<params>{inside}</params></methodCall>\r\n"
    ).encode()


def cpp_reply(value: Any) -> bytes:
    """A reply in the form of roscpp (XmlRpcServerConnection::generateResponse)."""
    return (
        '<?xml version="1.0"?>\r\n<methodResponse><params><param>\r\n\t'
        f"{cpp_value(value)}\r\n</param></params></methodResponse>\r\n"
    ).encode()


def raw_call(*values: str, method: str = "m", encoding: str = "utf-8") -> bytes:
    """A call around ``<value>`` elements given as text."""
    params = "".join(f"<param>{value}</param>" for value in values)
    return (
        f"<?xml version='1.0' encoding='{encoding}'?><methodCall><methodName>{method}</methodName>"
        f"<params>{params}</params></methodCall>"
    ).encode(encoding)


DIALECTS = {"rospy": (py_call, py_reply), "roscpp": (cpp_call, cpp_reply)}
"""The builders of calls and replies for each client library."""


def decoded(body: bytes) -> tuple[Any, str | None]:
    """The values and the method's name in a document, by Python's own decoder."""
    values, method = xmlrpc.client.loads(body)
    return values, method


def python_values(body: bytes) -> Any:
    """The same without the method's name, dates and binaries made comparable."""
    return comparable(decoded(body)[0])


def comparable(value: Any) -> Any:
    """A value with xmlrpc.client's DateTime and Binary turned into types that compare."""
    if isinstance(value, list | tuple):
        return [comparable(item) for item in value]
    if isinstance(value, dict):
        return {name: comparable(item) for name, item in value.items()}
    if isinstance(value, xmlrpc.client.Binary):
        return value.data
    if isinstance(value, xmlrpc.client.DateTime):
        return datetime.strptime(value.value, "%Y%m%dT%H:%M:%S")
    return value


def make_addressing(
    host: str = HOST,
    listen: tuple[int, int] = (45000, 45009),
    advertise: tuple[int, int] | None = None,
    networks: Sequence[str] = ("10.0.0.0/24",),
) -> Addressing:
    """The addressing of a proxy that knows no node yet."""
    ports = PortMap(PortRange(*listen), PortRange(*(advertise or listen)))
    inside_networks = tuple(map(ip_network, networks))
    return Addressing(Registry(ports.listen), host, ports, make_stand_ins(ports), inside_networks)


def make_stand_ins(ports: PortMap | None = None, **options: Any) -> StandIns:
    """The empty stand-ins of a proxy with the master ``robot``."""
    ports = ports or PortMap(PortRange(45000, 45009), PortRange(45000, 45009))
    settings = Settings(
        master_uri="http://robot:11311",
        advertise_host=HOST,
        port_range=ports.listen,
        advertise_port_range=ports.advertise,
        **options,
    )
    return StandIns(settings)


def make_caller(address: str, proxy: str = PROXY, **more: Any) -> Caller:
    """A caller at an inside address."""
    return Caller(address, proxy, **more)


def add_node(
    addressing: Addressing,
    uri: str = "http://10.0.0.5:40001/",
    address: str | None = None,
    named: bool | None = None,
    confirmed: bool = True,
) -> Endpoint:
    """Admit a node. ``address`` is by default the host in the URI."""
    node = parse_slave_uri(uri)
    assert node
    is_named = named if named is not None else address is None
    location = NodeLocation(address or node.host, is_named, confirmed)
    return addressing.registry.admit(uri, node, location, location.address)


def add_registration(
    addressing: Addressing, endpoint: Endpoint, kind: Kind, name: str, caller_id: str = "/talker"
) -> Registration:
    """Register something for an endpoint; a service at port 50001 of the node's host."""
    api = f"rosrpc://{HostPort(endpoint.node.host, 50001)}" if kind is Kind.SERVICE else None
    registration = Registration(kind, name, caller_id, "std_msgs/String", api, 1.0)
    addressing.registry.register(endpoint, registration)
    return registration


@dataclass
class Exchange:
    """A call of an inside node: what the master got, what the node got back, what was learned."""

    sent: bytes
    received: bytes
    facts: list[RegistryChange] = field(default_factory=list)


Refuse = Callable[[str], bool]


def exchange(
    addressing: Addressing,
    caller: Caller,
    body: bytes,
    reply: bytes,
    refuse: Refuse = lambda uri: False,
) -> Exchange:
    """Do the shell's work on a call: admit, export, ask the master, note, import."""
    request = master_calls.read_request(body, caller)
    outcomes = [_outcome(addressing, call, caller, refuse) for call in request.calls]
    exported = master_api.export_request(request, outcomes, addressing)
    if exported.body is None:
        return Exchange(b"", exported.local_reply())
    answer = master_calls.read_reply(exported, reply)
    facts = answer.registry_changes(7.0)
    for fact in facts:
        note(addressing.registry, fact)
    return Exchange(exported.body, master_api.import_reply(answer, addressing, unfiltered), facts)


def unfiltered(result: CallResult, caller: Caller) -> list[Edit]:
    """The edits of a policy without rules."""
    return []


def note(registry: Registry, fact: RegistryChange) -> None:
    """Take a fact into the registry."""
    registration = fact.registration
    if fact.endpoint:
        registry.register(fact.endpoint, registration)
    else:
        registry.unregister(registration.kind, registration.name, registration.caller_id)


def _outcome(
    addressing: Addressing, call: MasterCall | None, caller: Caller, refuse: Refuse
) -> CallOutcome:
    if call and call.spec.unregisters:
        return master_api.unregistering_endpoint(call, caller, addressing)
    return _admit(addressing, call.registering_uri if call else None, caller, refuse)


def _admit(addressing: Addressing, uri: str | None, caller: Caller, refuse: Refuse) -> CallOutcome:
    node = parse_slave_uri(uri) if uri else None
    if uri is None or node is None:
        return Passing.NO_REGISTRATION
    if refuse(uri):
        return refusal("rosproxy: no port is left")
    named = node.host.startswith("10.")
    location = NodeLocation(node.host if named else caller.address, named)
    return addressing.registry.admit(uri, node, location, caller.address)


def own_uri(address: str, port: int = 40001) -> str:
    """The slave URI of a node with an address as its host."""
    return slave_uri(HostPort(address, port))
