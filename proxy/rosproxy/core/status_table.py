"""``/status`` as text for people."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rosproxy.core.text import (
    GAP,
    besides_first,
    clean,
    duration,
    listed,
    plural,
    shorten,
    size,
    table,
    width,
    wrap,
)
from rosproxy.core.uris import parse_slave_uri

Status = Mapping[str, Any]
"""What ``/status`` returns."""

HEADING = ("NODE", "INSIDE", "OUTSIDE", "STATE", "PUB", "SUB", "SRV", "CONN", "OUT", "IN")
LEAST_NAME = 20
"""Columns for names; where the addresses leave less, they get a line of their own."""
MOST_LINES = 3
"""Lines that the topics or services of one node may take."""
MOST_CONNECTIONS = 8
INDENT = "    "


def render(status: Status, columns: int, lines: int | None = None) -> str:
    """The whole status in ``columns``; without the details of nodes if it has ``lines`` only."""
    full = [*_head(status), "", *_nodes(status, columns, True), *_problems(status, columns)]
    if lines is None or len(full) <= lines:
        return "\n".join(full)
    short = [*_head(status), "", *_nodes(status, columns, False), *_problems(status, columns)]
    return "\n".join(_cut(short, lines))


def _cut(text: list[str], lines: int) -> list[str]:
    if len(text) <= lines:
        return text
    return [*text[: lines - 1], f"… {len(text) - lines + 1} more lines: rosproxy status | less"]


def _head(status: Status) -> Iterator[str]:
    settings = status["settings"]
    up = f", up {duration(status['uptime'])}" if "uptime" in status else ""
    yield f"rosproxy {clean(status['version'])}, pid {status['pid']}{up}"
    yield f"master   {_master(status['master'])}"
    yield f"ports    {_ports(status)}"
    networks = listed(map(clean, settings["inside_networks"])) or "none"
    yield (
        f"inside   ROS_MASTER_URI=http://<this host>:{settings['master_port']}, networks {networks}"
    )
    if settings["publish_master"]:
        host = clean(settings["advertise_host"])
        yield f"outside  ROS_MASTER_URI=http://{host}:{settings['publish_master']}"


def _master(master: Status) -> str:
    uri, since = clean(master["uri"]), duration(master["since"])
    if master["up"]:
        trip = f", round trip {master['round_trip'] * 1000:.1f} ms" if master["round_trip"] else ""
        return f"{uri} up for {since}{trip} (pid {master['pid']})"
    if not master["error"]:
        return f"{uri} not asked yet"
    return f"{uri} DOWN for {since}: {clean(master['error']).removeprefix(f'master {uri}: ')}"


def _ports(status: Status) -> str:
    ports, host = status["ports"], clean(status["settings"]["advertise_host"])
    outside = f"{host}:{ports['advertise']}"
    mapped = "" if ports["advertise"] == ports["listen"] else f", here {ports['listen']}"
    blocked = f", {ports['blocked']} held by other programs" if ports["blocked"] else ""
    return f"{outside}{mapped}: {ports['used']} used, {ports['free']} free{blocked}"


def _nodes(status: Status, columns: int, details: bool) -> Iterator[str]:
    nodes = status["nodes"]
    if not nodes:
        yield "No node has registered through the proxy yet."
        return
    rows = [HEADING, *map(_row, nodes)]
    narrow = columns - besides_first(rows) < LEAST_NAME
    if narrow:
        rows = [(row[0], *row[3:]) for row in rows]
    room = max(columns - besides_first(rows), LEAST_NAME)
    heading, *lines = table(rows, 2 if narrow else 4, room)
    yield heading
    for node, line in zip(nodes, lines, strict=True):
        yield line
        if narrow:
            yield f"{INDENT}{'at':<11}{clean(node['address'])}, outside {_outside(node)}"
        if details:
            yield from _details(node, columns)


def _row(node: Status) -> tuple[str, ...]:
    names = [clean(name) for name in node["nodes"]] or ["(unnamed)"]
    connections = node["connections"]
    out, into = (
        f"{size(sum(c[key] for c in connections))}/s" if connections else "-"
        for key in ("sent_rate", "received_rate")
    )
    return (
        names[0] + (f" +{len(names) - 1}" if len(names) > 1 else ""),
        clean(node["address"]),
        _outside(node),
        clean(node["state"]),
        *(str(len(node[key])) for key in ("publishes", "subscribes", "services", "connections")),
        out,
        into,
    )


def _outside(node: Status) -> str:
    return clean(parse_slave_uri(node["advertised_uri"]) or node["advertised_uri"])


def _details(node: Status, columns: int) -> Iterator[str]:
    others = node["nodes"] if len(node["nodes"]) > 1 else ()
    for word, names in (
        ("also", others[1:]),
        ("publishes", node["publishes"]),
        ("subscribes", node["subscribes"]),
        ("services", node["services"]),
        ("parameters", node["parameters"]),
    ):
        yield from _names(word, [clean(name) for name in names], columns)
    connections = node["connections"]
    for connection in connections[:MOST_CONNECTIONS]:
        text = _connection(connection)
        yield from wrap(text, columns, f"{INDENT}{' ':<11}", f"{INDENT}{'connected':<11}")
    if len(connections) > MOST_CONNECTIONS:
        yield f"{INDENT}… {plural(len(connections) - MOST_CONNECTIONS, 'connection')} more"


def _names(word: str, names: Sequence[str], columns: int) -> Iterator[str]:
    """Names on at most MOST_LINES lines, then how many more."""
    lead = f"{INDENT}{word:<11}"
    indent = " " * len(lead)
    line, number = lead, 1
    for index, name in enumerate(names):
        word = shorten(name, max(columns - len(indent), 20))
        if line.strip() and line != lead and width(line + GAP + word) > columns:
            if number == MOST_LINES:
                yield f"{line}  … {len(names) - index} more"
                return
            yield line
            line, number = indent, number + 1
        line += word if line in (lead, indent) else GAP + word
    if names:
        yield line


def _connection(connection: Status) -> str:
    what = f"{clean(connection['kind'])} {clean(connection['name'])}"
    who = f"{clean(connection['caller_id']) or '?'} at {clean(connection['peer'])}"
    return f"{what} with {who}: {size(connection['sent'])} out, {size(connection['received'])} in"


def _problems(status: Status, columns: int) -> Iterator[str]:
    if status["problems"]:
        yield ""
        yield "problems (rosproxy doctor looks into them):"
    for problem in status["problems"]:
        text = f"{clean(problem['subject'])}: {clean(problem['text'])}"
        yield from wrap(f"{duration(problem['age'])} ago  {text}", columns, INDENT, "  ")
