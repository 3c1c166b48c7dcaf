"""The JSON document of the live page: nodes, links between nodes, and findings.

Proxies make this document for ROS 1, ROS 2 and rmw_zenoh, and both operators make the same document
for several proxies. Nodes choose the names in the document. `shown_name` and `shown_text` shorten
these names, but do not escape HTML: show these names only as text.
"""

from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from typing import Any, TypeVar

import msgspec
from msgspec.structs import replace

from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity
from rosproxy.shared.documents.status_bounds import encoded_size
from rosproxy.shared.output.text import brief

ROBOT = "robot"
HOST = "host"
CONTAINER = "container"
"""The lanes of the graph: outside, the machine of the proxy, inside."""
OK = "ok"
UNKNOWN = "unknown"
WARNING = "warning"
BROKEN = "broken"
"""States of nodes and links."""
MOST_NODES = 1500
MOST_LINKS = 3000
MOST_FINDINGS = 50
"""Bounds of the document. ``left_out`` counts further nodes and links, but no findings."""
MOST_NODE_BYTES = 1024 * 1024
MOST_LINK_BYTES = 4 * MOST_NODE_BYTES
"""Bounds of all nodes and of all links in bytes, as JSON in ASCII. A document is made each second.
With names of 50 characters and no faults, MOST_NODES and MOST_LINKS have 2 MB."""
LONGEST_NAME = 300
"""Most characters of a name."""
LONGEST_TEXT = 1000
"""Most characters of a problem or a fix."""
QUIET = frozenset({"/rosout", "/rosout_agg", "/tf", "/tf_static", "/parameter_events"})
"""Topics that nearly every node has. The page hides these topics by default."""
_QUIET_SERVICES = ("/get_loggers", "/set_logger_level")
Json = dict[str, Any]
Row = TypeVar("Row", bound=msgspec.Struct)


class PageNode(msgspec.Struct, frozen=True, omit_defaults=True):
    """A node, participant, master, router or proxy in its lane.

    ``label``: the text to show if the key is not a name. ``detail``: the text to show if a user
    selects the node; for a proxy, the versions of ROS. ``place``: the name of the container or pod,
    if known. ``text`` and ``fix``: the problem and what to do. ``ports``: the ports of the proxy
    for this node. ``rate``: forwarded bytes a second, if the rates of the links are not known.
    ``proxy``: the proxy of the node, on an operator's page. ``since``: the Unix time in seconds
    since which a router is linked or not. ``wrong_since``: the Unix time in seconds at which the
    process first saw the problem (`rosproxy.page.problem_ages`). ``may_be_older``: the first
    documents of an opened page had the problem, which may be older than the page.
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
    detail: str = ""
    place: str = ""
    since: float | None = None
    wrong_since: float | None = None
    may_be_older: bool = False


class PageLink(msgspec.Struct, frozen=True, omit_defaults=True):
    """A topic from a publisher to a subscriber, or a service or parameter of a node.

    ``target``: empty if only one end is known. ``carried``: kernel, splice, copy, UDPROS, or router
    (of rmw_zenoh); direct if the link does not pass the proxy; empty if unknown. ``port``: the port
    of the proxy. ``rate``: bytes a second. ``hz``: messages a second. ``since``: the Unix time in
    seconds of the last message, if nothing flows. None means unknown. ``flows``: messages pass now.
    ``quiet``: the page hides the link by default. ``proxy``: the key of the proxy with the
    ``port``, on an operator's page. ``type``: the ROS type; empty if unknown. ``wrong_since`` and
    ``may_be_older`` as of a node.

    ``datagrams``: user data of ROS 2 in datagrams per second. If ``shared`` is 2 or more, the
    measures are a sum over this number of links to the same participant, services of the
    participant, and links whose acknowledgements come back to the participant.
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
    datagrams: float | None = None
    shared: int = 0
    type: str = ""
    wrong_since: float | None = None
    may_be_older: bool = False

    @property
    def key(self) -> str:
        """The key of the link in the document."""
        return f"{self.kind} {self.name} {self.source} {self.target}"


def document(
    proxy: Json,
    nodes: dict[str, PageNode],
    links: Iterable[PageLink],
    findings: Iterable[DoctorFinding],
    left_out: int = 0,
) -> Json:
    """The document, within the bounds, with warnings and errors among ``findings``.

    ``left_out``: the number of links that the caller has left out of ``links``.
    """
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
    """The nodes and links within the bounds.

    Broken nodes and links come first, with the nodes at both ends of a broken link. Then come links
    that are not quiet. A link without the node at either end is left out.
    """
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
    """The first rows, with their keys, that together need at most ``room`` bytes as JSON."""
    for keyed in rows:
        room -= encoded_size(keyed)
        if room < 0:
            return
        yield keyed


def _shown_link(link: PageLink) -> PageLink:
    """A link with the keys that its nodes have in the document."""
    return replace(link, source=shown_name(link.source), target=shown_name(link.target))


class PageFinding(msgspec.Struct, frozen=True):
    """A finding, with the severity as a word. The last two fields as of a node."""

    severity: str = ""
    subject: str = ""
    text: str = ""
    fix: str = ""
    wrong_since: float | None = None
    may_be_older: bool = False


class PageProxy(msgspec.Struct, frozen=True):
    """The values of a proxy that an operator needs to merge documents."""

    host: str = ""
    master: str = ""


class Document(msgspec.Struct, frozen=True):
    """A document that an operator has read from a proxy."""

    nodes: dict[str, PageNode]
    links: dict[str, PageLink]
    findings: tuple[PageFinding, ...] = ()
    proxy: PageProxy = PageProxy()
    left_out: int = 0


def is_quiet_service(name: str) -> bool:
    """Whether every node has a service of this name, such as ``/NODE/get_loggers``."""
    return name.endswith(_QUIET_SERVICES)


def rounded(value: float) -> float:
    """A value with two significant digits. Otherwise each small change would send the row again."""
    return float(f"{value:.2g}")


def shown_name(name: str) -> str:
    """A name for the document: shortened, with control characters escaped."""
    return brief(name, LONGEST_NAME)


def shown_text(text: str) -> str:
    """A problem or fix for the document: shortened, with control characters escaped."""
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
