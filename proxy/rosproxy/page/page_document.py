"""What the live page shows: nodes, the links between them, and findings, as one JSON document.

Both versions of ROS and both operators make such a document; the page knows no other. Texts are
what nodes call themselves and things, shortened, and harmless only as text.
"""

from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from typing import Any, TypeVar

import msgspec
from msgspec.structs import replace

from rosproxy.admin.doctor_finding import DoctorFinding, Severity
from rosproxy.admin.status_bounds import encode
from rosproxy.telemetry.text import brief

ROBOT = "robot"
HOST = "host"
CONTAINER = "container"
"""The lanes: outside, the machine of the proxy, and inside."""
OK = "ok"
UNKNOWN = "unknown"
WARNING = "warning"
BROKEN = "broken"
"""States of nodes and links."""
MOST_NODES = 1500
MOST_LINKS = 3000
MOST_FINDINGS = 50
"""How many are shown; the rest is counted."""
MOST_NODE_BYTES = 1024 * 1024
MOST_LINK_BYTES = 4 * MOST_NODE_BYTES
"""Bytes of all nodes that are shown, and of all links, as JSON in ASCII. The document is made each
second. With names of 50 characters, and nothing wrong, all of them have 2 MB."""
LONGEST = 300
"""Characters of a name."""
LONGEST_TEXT = 1000
"""Characters of what is wrong, and of its fix."""
QUIET = frozenset({"/rosout", "/rosout_agg", "/tf", "/tf_static", "/parameter_events"})
"""Topics that nearly every node has: hidden until they are asked for."""
_QUIET_SERVICES = ("/get_loggers", "/set_logger_level")
Json = dict[str, Any]
Row = TypeVar("Row", bound=msgspec.Struct)


class PageNode(msgspec.Struct, frozen=True, omit_defaults=True):
    """A node, participant, master or proxy in its lane.

    ``label`` is shown where the key is no name. ``ports`` are those that stand for it outside,
    ``rate`` what is forwarded for it where that is not known of each link, in bytes per second.
    ``proxy``: whose it is, where there are several.
    """

    lane: str
    kind: str = "node"
    label: str = ""
    state: str = OK
    text: str = ""
    fix: str = ""
    address: str = ""
    ports: str = ""
    rate: float | None = None
    proxy: str = ""


class PageLink(msgspec.Struct, frozen=True, omit_defaults=True):
    """A topic from a publisher to a subscriber, or a service or parameter and who has it.

    ``target`` is empty where there is none. ``carried``: kernel, splice, copy, UDPROS, or direct
    where it does not pass the proxy; empty if that is not known. ``port``: the proxy's. ``rate`` is
    in bytes and ``hz`` in messages per second, ``since`` when something came last that does not
    come just now, in seconds since the epoch; None: not known. ``proxy``: the key of the proxy with
    the ``port``, where there are several.
    """

    kind: str
    name: str
    source: str
    target: str = ""
    carried: str = ""
    port: int | None = None
    rate: float | None = None
    hz: float | None = None
    since: float | None = None
    flows: bool = False
    state: str = UNKNOWN
    text: str = ""
    fix: str = ""
    quiet: bool = False
    proxy: str = ""

    @property
    def key(self) -> str:
        """What tells it from all others."""
        return f"{self.kind} {self.name} {self.source} {self.target}"


def document(
    proxy: Json,
    nodes: dict[str, PageNode],
    links: Iterable[PageLink],
    findings: Iterable[DoctorFinding],
    left_out: int = 0,
) -> Json:
    """All of it within bounds; ``left_out``: how many links are not even among these."""
    nodes = {shown_name(key): node for key, node in nodes.items()}
    by_key = {link.key: link for link in map(_shown_link, links)}
    worst = [f for f in findings if f.severity >= Severity.WARNING]
    worst.sort(key=lambda f: -f.severity)
    shown_nodes, shown = within_bounds(nodes, by_key)
    return {
        "proxy": proxy,
        "nodes": {key: _plain(node) for key, node in shown_nodes.items()},
        "links": {key: _plain(link) for key, link in shown.items()},
        "findings": [_finding(f) for f in worst[:MOST_FINDINGS]],
        "left_out": left_out + len(nodes) - len(shown_nodes) + len(by_key) - len(shown),
    }


def within_bounds(
    nodes: Mapping[str, PageNode],
    links: Mapping[str, PageLink],
    most_nodes: int = MOST_NODES,
    most_links: int = MOST_LINKS,
) -> tuple[dict[str, PageNode], dict[str, PageLink]]:
    """As many nodes and links as are shown: first what is broken, then what is not quiet."""
    order = sorted(links, key=lambda key: (links[key].state != BROKEN, links[key].quiet, key))
    broken = [links[key] for key in order if links[key].state == BROKEN]
    important = {end for link in broken for end in (link.source, link.target)}
    important |= {key for key, node in nodes.items() if node.state == BROKEN}
    first = sorted(nodes, key=lambda key: key not in important)
    by_importance = ((key, nodes[key]) for key in islice(first, most_nodes))
    shown_nodes = dict(_fitting(by_importance, MOST_NODE_BYTES))
    targets = {"", *shown_nodes}
    complete = (
        (key, links[key])
        for key in order
        if links[key].source in shown_nodes and links[key].target in targets
    )
    return shown_nodes, dict(_fitting(islice(complete, most_links), MOST_LINK_BYTES))


def _fitting(rows: Iterable[tuple[str, Row]], room: int) -> Iterator[tuple[str, Row]]:
    """The first rows with their keys, as many as have ``room`` bytes together."""
    for keyed in rows:
        room -= len(encode(keyed))
        if room < 0:
            return
        yield keyed


def _shown_link(link: PageLink) -> PageLink:
    """A link with its ends as the nodes are called in the document."""
    return replace(link, source=shown_name(link.source), target=shown_name(link.target))


class PageFinding(msgspec.Struct, frozen=True):
    """A finding, with its severity in words."""

    severity: str = ""
    subject: str = ""
    text: str = ""
    fix: str = ""


class PageProxy(msgspec.Struct, frozen=True):
    """What of a proxy's own is needed to show it among several."""

    host: str = ""
    master: str = ""


class Document(msgspec.Struct, frozen=True):
    """A document as its reader has it."""

    nodes: dict[str, PageNode]
    links: dict[str, PageLink]
    findings: tuple[PageFinding, ...] = ()
    proxy: PageProxy = PageProxy()
    left_out: int = 0


def is_quiet_service(name: str) -> bool:
    """Whether every node has such a service."""
    return name.endswith(_QUIET_SERVICES)


def rounded(value: float) -> float:
    """A measure as it is shown: a change in the third digit alone is not sent."""
    return float(f"{value:.2g}")


def shown_name(name: str) -> str:
    """A name as it is shown."""
    return brief(name, LONGEST)


def shown_text(text: str) -> str:
    """What is wrong, or a fix, as it is shown."""
    return brief(text, LONGEST_TEXT)


def _plain(struct: PageNode | PageLink) -> Json:
    plain: Json = msgspec.to_builtins(struct)
    return plain


def _finding(finding: DoctorFinding) -> Json:
    plain: Json = msgspec.to_builtins(
        PageFinding(
            finding.severity.name.lower(),
            shown_name(finding.subject),
            shown_text(finding.text),
            shown_text(finding.fix),
        )
    )
    return plain
