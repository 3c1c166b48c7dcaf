"""``/status`` as text: first the proxy, then a table of the nodes behind the proxy.

Below the row of a node are topics, services and connections. A narrow terminal has the addresses
of nodes in separate lines. A short terminal (``--watch``) may have no details. Nodes choose the
names in the status, so `clean` makes these names harmless.
"""

from collections.abc import Iterator, Sequence

from rosproxy.cli.domain_table import domain_lines
from rosproxy.cli.zenoh_table import zenoh_lines
from rosproxy.shared.documents import status_document as document
from rosproxy.shared.documents.status_bounds import left_out
from rosproxy.shared.output.tables import GAP, besides_first, table
from rosproxy.shared.output.text import clean, duration, listed, plural, size, wrap
from rosproxy.shared.uris import parse_slave_uri

HEADING = ("NODE", "INSIDE", "OUTSIDE", "STATE", "PUB", "SUB", "SRV", "CONN", "OUT", "IN")
LEAST_NAME_COLUMNS = 20
"""Columns for names at least. If the addresses leave fewer, each address gets a separate line."""
MOST_LINES = 3
"""Lines for the topics of a node at most; the same for services and for connections."""
MOST_CONNECTIONS = 8
"""Connections of a node that are listed at most."""
MOST_HIDDEN = 20
"""Hidden names that are listed at most."""
INDENT = "    "


def render(status: document.ProxyStatus, columns: int, lines: int | None = None) -> str:
    """The status as text, wrapped to ``columns``, with at most ``lines`` lines; None: no bound.

    A longer text first loses the details of nodes and the hidden names, then the last lines.
    """
    # Each line of the head begins with a label of nine characters. Further lines are indented.
    head = [line for row in _head(status) for line in wrap(row[9:], columns, " " * 9, row[:9])]
    problems = [*_problems(status, columns)]
    hidden = [*_hidden(status, columns)]
    domains = [line for domain in status.domains for line in domain_lines(domain, columns)]
    if status.zenoh:
        domains += zenoh_lines(status.zenoh, columns)
    nodes, brief = (["", *_nodes(status, columns, details)] for details in (True, False))
    if not status.settings.for_ros1:
        nodes = []
        brief = []
    full = [*head, *nodes, *domains, *hidden, *problems]
    if lines is None or len(full) <= lines:
        return "\n".join(full)
    # The end may be cut off, so problems come before nodes.
    short = [*head, *problems, *brief, *domains]
    if len(short) > lines:
        short[lines - 1 :] = [f"… {plural(len(short) - lines + 1, 'line')} more: rosproxy status"]
    return "\n".join(short)


def _head(status: document.ProxyStatus) -> Iterator[str]:
    settings = status.settings
    yield f"rosproxy {clean(status.version)}, pid {status.pid}, up {duration(status.uptime)}"
    if settings.for_ros1:
        yield f"master   {_master(status.master)}"
    yield from _range(status)
    if (policy := status.policy) and policy.layers:
        yield f"policy   {_policy(policy)}"
    if inside := _inside(status):
        yield f"inside   {inside}"
    if stand_ins := status.stand_ins:
        yield f"outside  {_stand_ins(stand_ins)}"
    if settings.publish_master:
        host = clean(settings.advertise_host)
        yield f"outside  ROS_MASTER_URI=http://{host}:{settings.publish_master}"
    if missing := left_out(status):
        entries = f"{plural(missing, 'name')} and entries"
        yield f"left out {entries}: /status is bounded, see docs/reference/limits.md"


def _range(status: document.ProxyStatus) -> Iterator[str]:
    """The range and the data plane; rmw_zenoh alone has no range."""
    if status.ports.listen:
        yield f"ports    {_ports(status)}"
    if status.settings.for_ros1 and (plane := status.data_plane):
        yield f"topics   {_plane(plane)}"


def _inside(status: document.ProxyStatus) -> str:
    """How nodes inside find the proxy; empty if the proxy serves rmw_zenoh alone."""
    settings = status.settings
    networks = listed(map(clean, settings.inside_networks)) or "none"
    selected = settings.selected
    chosen = "" if selected is None else f", {plural(selected, 'address')} selected"
    if settings.for_ros1:
        inside = f"ROS_MASTER_URI=http://<this host>:{settings.master_port}"
    elif status.domains or not status.zenoh:
        inside = f"ROS 2, domain {listed(str(domain.domain) for domain in status.domains)}"
    else:
        return ""
    return f"{inside}, networks {networks}{chosen}"


def _master(master: document.MasterStatus) -> str:
    uri = clean(master.uri)
    since = duration(master.since)
    if master.up:
        trip = f", round trip {master.round_trip * 1000:.1f} ms" if master.round_trip else ""
        return f"{uri} up for {since}{trip} (pid {master.pid})"
    if not master.error:
        return f"{uri} not asked yet"
    return f"{uri} DOWN for {since}: {clean(master.error).removeprefix(f'master {uri}: ')}"


def _ports(status: document.ProxyStatus) -> str:
    ports = status.ports
    host = clean(status.settings.advertise_host)
    listen = clean(ports.listen)
    advertise = clean(ports.advertise)
    mapped = "" if advertise == listen else f", here {listen}"
    holders = "; ".join(map(clean, ports.held_by)) or "other programs"
    blocked = f", {ports.blocked} held by {holders}" if ports.blocked else ""
    used = f"{ports.used} used, {ports.free} free{blocked}"
    return f"{host}:{advertise}{mapped}: {used}{_reached(status.range_probe)}"


def _reached(probe: document.RangeProbeStatus | None) -> str:
    """Whether outside reaches the range; empty if unknown. Only the master tries from outside."""
    if probe is None or probe.reached is None:
        return ""
    if probe.reached and probe.from_master != "ok":
        return ", reached from this host"
    return ", reached from outside" if probe.reached else ", NOT reached from outside"


def _policy(policy: document.PolicyStatus) -> str:
    """The layers, with numbers of rules, and the number of hidden names."""
    layers = (
        f"{clean(layer.name)}: {plural(len(layer.rules), 'rule')}"
        + (" (audit only)" if layer.mode == "audit" else "")
        for layer in policy.layers
    )
    return f"{listed(layers)}; {plural(len(policy.hidden) + policy.left_out, 'name')} hidden"


def _plane(plane: document.DataPlaneStatus) -> str:
    if plane.plane == "kernel":
        return f"forwarded by the kernel (data plane {clean(plane.mode)})"
    return f"relayed by the proxy ({clean(plane.plane)}): {clean(plane.reason)}"


def _stand_ins(stand_ins: Sequence[document.StandInStatus]) -> str:
    connections = plural(sum(stand_in.connections for stand_in in stand_ins), "connection")
    into = size(sum(stand_in.received_rate for stand_in in stand_ins))
    targets = listed(f"{stand_in.port} for {clean(stand_in.uri)}" for stand_in in stand_ins)
    count = plural(len(stand_ins), "port")
    return f"reached from inside at {count} ({connections}, {into}/s in): {targets}"


def _nodes(status: document.ProxyStatus, columns: int, details: bool) -> Iterator[str]:
    nodes = status.nodes
    if not nodes:
        yield "No node has registered through the proxy yet."
        return
    rows = [HEADING, *map(_row, nodes)]
    narrow = columns - besides_first(rows) < LEAST_NAME_COLUMNS
    if narrow:
        rows = [(row[0], *row[3:]) for row in rows]
    room = max(columns - besides_first(rows), len(HEADING[0]))
    heading, *lines = table(rows, 2 if narrow else 4, room)
    yield heading
    for node, line in zip(nodes, lines, strict=True):
        yield line
        if narrow:
            yield from _detail("at", f"{clean(node.address)}, outside {_outside(node)}", columns)
        if details:
            yield from _details(node, status.data_plane, columns)


def _row(node: document.EndpointStatus) -> tuple[str, ...]:
    names = [clean(name) for name in node.nodes] or ["(unnamed)"]
    plane = node.data_plane or document.NodePlaneStatus()
    connections = [*node.connections, plane]
    count = len(node.connections) + plane.connections
    out, into = (
        f"{size(sum(getattr(c, key) for c in connections))}/s" if count else "-"
        for key in ("sent_rate", "received_rate")
    )
    return (
        names[0] + (f" +{len(names) - 1}" if len(names) > 1 else ""),
        clean(node.address),
        _outside(node),
        clean(node.state),
        *(str(len(registered)) for registered in (node.publishes, node.subscribes, node.services)),
        str(count),
        out,
        into,
    )


def _outside(node: document.EndpointStatus) -> str:
    return clean(parse_slave_uri(node.advertised_uri) or node.advertised_uri)


def _details(
    node: document.EndpointStatus, data_plane: document.DataPlaneStatus | None, columns: int
) -> Iterator[str]:
    for label, names in (
        ("also", node.nodes[1:]),
        ("publishes", node.publishes),
        ("subscribes", node.subscribes),
        ("services", node.services),
        ("parameters", node.parameters),
    ):
        yield from _detail(label, GAP.join(map(clean, names)), columns)
    connections = node.connections
    for connection in connections[:MOST_CONNECTIONS]:
        yield from _detail("connected", _connection(connection), columns)
    if len(connections) > MOST_CONNECTIONS:
        yield f"{INDENT}… {plural(len(connections) - MOST_CONNECTIONS, 'connection')} more"
    if node.left_out:
        yield from _detail("not shown", f"{node.left_out} more names and connections", columns)
    yield from _detail("kernel", _kernel(node, data_plane), columns)


def _kernel(node: document.EndpointStatus, data_plane: document.DataPlaneStatus | None) -> str:
    """What the kernel forwards for a node, or the reason if the kernel plane is in use."""
    plane = node.data_plane
    if plane is None or data_plane is None or data_plane.plane != "kernel":
        return ""
    connections = f"{plural(plane.connections, 'connection')} through port {plane.port}"
    traffic = f"{size(plane.sent)} out, {size(plane.received)} in as IP packets"
    if plane.plane == "kernel":
        return f"{connections}: {traffic}"
    return f"not used: {clean(plane.reason)}"


def _detail(label: str, text: str, columns: int) -> list[str]:
    lead = f"{INDENT}{label:<11}"
    return wrap(text, columns, " " * len(lead), lead, MOST_LINES)


def _connection(connection: document.ConnectionStatus) -> str:
    subject = f"{clean(connection.kind)} {clean(connection.name)}"
    peer = f"{clean(connection.caller_id) or '?'} at {clean(connection.peer)}"
    return f"{subject} with {peer}: {size(connection.sent)} out, {size(connection.received)} in"


def _hidden(status: document.ProxyStatus, columns: int) -> Iterator[str]:
    """The names that outside does not see, each with the rule."""
    hidden = status.policy.hidden if status.policy else ()
    if hidden:
        yield from ("", "hidden from outside:")
    for registration in hidden[:MOST_HIDDEN]:
        label = (
            f"{clean(registration.kind)} {clean(registration.name)} of {clean(registration.node)}"
        )
        yield from wrap(f"{label}  {clean(registration.reason)}", columns, INDENT, "  ")
    if len(hidden) > MOST_HIDDEN:
        yield f"{INDENT}… {plural(len(hidden) - MOST_HIDDEN, 'name')} more: rosproxy status --json"


def _problems(status: document.ProxyStatus, columns: int) -> Iterator[str]:
    """All problems except the problem of the master, which has a line in the head."""
    problems = [problem for problem in status.problems if problem.subject != "master"]
    if problems:
        yield from ("", "problems (run rosproxy doctor to examine them):")
    for problem in problems:
        text = f"{clean(problem.subject)}: {clean(problem.text)}"
        yield from wrap(f"{duration(problem.age)} ago  {text}", columns, INDENT, "  ")
