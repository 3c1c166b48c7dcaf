"""Render the status of a Docker host as text for people.

Users choose the names of containers, networks and nodes freely. So `clean` makes all names safe for
a terminal.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from rosproxy.shared.output.tables import besides_first, table
from rosproxy.shared.output.text import clean, listed, plural, shorten, wrap
from rosproxy_operator.common.problem import with_fix

Status = Mapping[str, Any]
"""What ``rosproxy-operator docker status --json`` prints."""

PROXY_HEADINGS = ("PROXY", "STATE", "MASTER OR DOMAIN", "OUTSIDE", "PORTS")
CONTAINER_HEADINGS = ("CONTAINER", "STATE", "PROXY", "PORTS", "NODES")
LEAST_NAME_COLUMNS = 20
"""Least columns of the first column, the names, even if the line is then too long."""
MOST_NODE_LINES = 3
"""Most lines for the nodes of a container, and for the topics of a participant or node."""
INDENT = "    "


def render(status: Status, columns: int, lines: int | None = None) -> str:
    """Return the status, wrapped at ``columns`` characters.

    If the text has more than ``lines`` lines, the table of proxies and the details of containers
    are left out. If the text still is too long, the end is left out. None: any number of lines.
    """
    proxies = len(status["proxies"])
    containers = len({container["name"] for container in status["containers"]})
    head = wrap(
        f"rosproxy-operator {clean(status['version'])}: {plural(containers, 'container')}, "
        f"{plural(proxies, 'proxy')}, uplink network "
        f"{clean(status['uplink'])}",
        columns,
        "",
    )
    if status["operator"] is None:
        text = "No operator was asked: this is the view of an operator with these options."
        head += wrap(text, columns, "")
    else:
        head += wrap(f"Live page of all proxies: {clean(status['operator'])}/", columns, "")
    subjects = {f"container {container['name']}" for container in status["containers"]}
    problems = [
        f"{clean(problem['subject'])}: {clean(message_of(problem))}"
        for problem in status["problems"]
        if problem["subject"] not in subjects
    ]
    steps = [clean(action) for action in status["actions"]]
    ending = _listing("problems:", problems, columns)
    ending += _listing(f"{plural(len(steps), 'step')} left:", steps, columns)
    full = [*head, "", *_proxies(status, columns), "", *_containers(status, columns, True), *ending]
    if lines is None or len(full) <= lines:
        return "\n".join(full)
    short = [*head, *ending, "", *_containers(status, columns, False)]
    if len(short) > lines:
        hidden = plural(len(short) - lines + 1, "line")
        short[lines - 1 :] = [f"… {hidden} more: rosproxy-operator docker status"]
    return "\n".join(short)


def _proxies(status: Status, columns: int) -> Iterator[str]:
    proxies = status["proxies"]
    if not proxies:
        yield "No proxy."
        return
    heading, *rows = _table([PROXY_HEADINGS, *map(_proxy_row, proxies)], columns)
    yield heading
    for proxy, row in zip(proxies, rows, strict=True):
        yield row
        yield from _problem_lines(proxy["problems"], columns)


def _proxy_row(proxy: Status) -> tuple[str, ...]:
    lost = proxy["state"] == "running" and not proxy["reachable"]
    return (
        clean(proxy["name"]),
        clean(proxy["state"]) + (", no answer" if lost else ""),
        _graph(proxy),
        _outside(proxy),
        clean(proxy["range"]) + (f" {proxy['used']} used" if proxy["used"] is not None else ""),
    )


def _outside(proxy: Status) -> str:
    """The host at which outside reaches a proxy; for rmw_zenoh the routers outside."""
    if proxy["ros"] != "zenoh":
        return clean(proxy["advertise_host"])
    links = (clean(peer) + ("" if up else " DOWN") for peer, up in proxy["links"].items())
    return listed(links) or "no peers"


def _graph(proxy: Status) -> str:
    """The master or domain of a proxy, or rmw_zenoh."""
    if proxy["ros"] == "zenoh":
        return "rmw_zenoh"
    if proxy["ros"] == "2":
        return f"domain {proxy['domain']}" + (
            ", no LAN relay" if proxy["lan_relay"] is None else ""
        )
    return clean(proxy["master_uri"]) + (" DOWN" if proxy["master_up"] is False else "")


def _containers(status: Status, columns: int, details: bool) -> Iterator[str]:
    containers = status["containers"]
    if not containers:
        yield "No container is labelled: docker run --label rosproxy.enable=true …"
        return
    ranges = {proxy["name"]: proxy["range"] for proxy in status["proxies"]}
    heading, *rows = _table(
        [CONTAINER_HEADINGS, *(_container_row(c, ranges) for c in containers)], columns
    )
    yield heading
    reported: set[str] = set()
    for container, row in zip(containers, rows, strict=True):
        yield row
        if details and (redirect := container["redirect"]):
            effect = (
                "is redirected to the proxy"
                if redirect["in_place"]
                else "is not redirected to the proxy yet"
            )
            yield from wrap(f"{redirect['master']} {effect}", columns, INDENT)
        if details:
            names = [clean(name) for node in container["nodes"] for name in node["names"]]
            yield from wrap("  ".join(names), columns, INDENT, most=MOST_NODE_LINES)
            for participant in container["participants"]:
                text = _topics(_participant_name(participant), participant)
                yield from wrap(text, columns, INDENT, most=MOST_NODE_LINES)
            for node in container["zenoh_nodes"]:
                yield from wrap(_topics(node["name"], node), columns, INDENT, most=MOST_NODE_LINES)
        yield from _problem_lines(
            filter(None, (p["problem"] for p in container["participants"])), columns
        )
        # A container with both versions of ROS has two rows, and the report shows problems once.
        subject = f"container {container['name']}"
        if subject not in reported:
            own = (p for p in status["problems"] if p["subject"] == subject)
            yield from _problem_lines(map(message_of, own), columns)
        reported.add(subject)


def _participant_name(participant: Status) -> str:
    """The nodes of a participant, as far as they are known, and the vendor."""
    nodes = listed(participant["nodes"])
    return f"{nodes} ({participant['vendor']})" if nodes else participant["vendor"]


def _topics(name: str, row: Status) -> str:
    """The topics and services of a participant or a node, as a line."""
    verbs = (("publishes", "publishes"), ("subscribes to", "subscribes"), ("serves", "services"))
    texts = [f"{verb} {'  '.join(map(clean, row[key]))}" for verb, key in verbs if row[key]]
    return f"{clean(name)}: {'; '.join(texts) or 'nothing announced yet'}"


def _container_row(container: Status, ranges: Mapping[str, str]) -> tuple[str, ...]:
    name = container["name"]
    state = container["state"]
    proxy = container["proxy"]
    cells = map(clean, (name, state, proxy or "-", ranges.get(proxy, "-")))
    participants = plural(len(container["participants"]), "participant")
    nodes = str(len(container["nodes"]) + len(container["zenoh_nodes"]))
    return (*cells, participants if container["ros"] == "2" else nodes)


def message_of(problem: Status) -> str:
    """What is wrong and the fix. An operator of an earlier build has the fix in the text."""
    return with_fix(problem["text"], problem.get("fix", ""))


def _problem_lines(texts: Iterable[str], columns: int) -> Iterator[str]:
    for text in texts:
        yield from wrap(clean(text), columns, INDENT + "  ", f"{INDENT}! ")


def _listing(title: str, texts: Sequence[str], columns: int) -> list[str]:
    lines = [line for text in texts for line in wrap(text, columns, INDENT, "  ")]
    return ["", title, *lines] if texts else []


def _table(rows: list[tuple[str, ...]], columns: int) -> list[str]:
    room = max(columns - besides_first(rows), LEAST_NAME_COLUMNS)
    return table(
        [tuple(shorten(cell, columns) for cell in row) for row in rows], len(rows[0]), room
    )
