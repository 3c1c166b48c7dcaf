"""The live pages of several proxies as one document.

Each proxy has its own nodes inside. Outside is the same for all proxies of one master, so its
nodes appear once, and a link between two nodes does; and what is outside for one proxy may be
inside for another. A master on loopback is another one on each host. Participants of ROS 2 are the
same wherever they have one name, which is made to be nobody else's. A proxy that can't be asked is
a node that says why.
"""

from collections.abc import Callable, Mapping
from typing import Any

import msgspec
from msgspec.structs import replace

from rosproxy.net.addresses import is_loopback, parse_authority
from rosproxy.page.page_document import (
    BROKEN,
    CONTAINER,
    HOST,
    MOST_FINDINGS,
    OK,
    WARNING,
    Document,
    PageFinding,
    PageLink,
    PageNode,
    within_bounds,
)

Json = dict[str, Any]
PROXY, PARTICIPANT = "proxy", "participant"
_RANKS = {WARNING: 1, BROKEN: 2}
"""How bad a state is; others are not."""


def read_document(text: str) -> Document:
    """The document in a proxy's answer. Raises ValueError."""
    try:
        return msgspec.json.decode(text, type=Document)
    except msgspec.DecodeError as error:
        raise ValueError(str(error)) from None


def merged(
    documents: Mapping[str, Document | str], version: str, logs: Callable[[str], str]
) -> Json:
    """One document of those of all proxies, by name; a text says why one can't be asked.

    ``logs`` gives the command that shows those of a proxy.
    """
    nodes: dict[str, PageNode] = {}
    links: dict[str, PageLink] = {}
    findings: list[PageFinding] = []
    left_out = 0
    inside = _inside(documents)
    for name, document in documents.items():
        if isinstance(document, str):
            text = f"it can't be asked: {document}"
            nodes[name] = PageNode(HOST, PROXY, name, BROKEN, text, logs(name))
            continue
        names = {key: _key(name, document, key, node) for key, node in document.nodes.items()}
        for key, node in document.nodes.items():
            if node.lane != CONTAINER and names[key] in inside:
                names[key] = inside[names[key]]  # another proxy tells of it, who knows it better
                continue
            known = nodes.get(names[key])
            if known and _RANKS.get(known.state, 0) > _RANKS.get(node.state, 0):
                continue  # a proxy before has found more wrong with it
            label = name if node.kind == PROXY else node.label or key
            owner = name if node.lane == CONTAINER else ""
            nodes[names[key]] = replace(node, label=label, proxy=owner)
        for link in document.links.values():
            if link.source in names and (not link.target or link.target in names):
                target = names.get(link.target, "")
                named = replace(link, source=names[link.source], target=target)
                links[named.key] = max(links.get(named.key, named), named, key=_telling)
        findings += (replace(f, subject=f"{name}: {f.subject}") for f in document.findings)
        left_out += document.left_out
    shown, kept = within_bounds(nodes, links)
    return {
        "proxy": {"host": f"{len(documents)} proxies", "version": version},
        "nodes": msgspec.to_builtins(shown),
        "links": msgspec.to_builtins(kept),
        "findings": msgspec.to_builtins(findings[:MOST_FINDINGS]),
        "left_out": left_out + len(nodes) - len(shown) + len(links) - len(kept),
    }


def _telling(link: PageLink) -> tuple[int, bool, bool]:
    """How much a link tells, where several proxies have it: the worst, then who carries it."""
    return _RANKS.get(link.state, 0), link.state == OK, link.port is not None


def _inside(documents: Mapping[str, Document | str]) -> dict[str, str]:
    """The keys of the nodes inside, by those that they have for proxies outside which they are."""
    return {
        _outside_key(name, document, key, node): _key(name, document, key, node)
        for name, document in documents.items()
        if not isinstance(document, str)
        for key, node in document.nodes.items()
        if node.lane == CONTAINER
    }


def _key(name: str, document: Document, key: str, node: PageNode) -> str:
    """A node's key, different for each proxy, but the same for one node outside."""
    if node.lane == CONTAINER or node.kind == PROXY:
        return f"{name} {key}"
    return _outside_key(name, document, key, node)


def _outside_key(name: str, document: Document, key: str, node: PageNode) -> str:
    if node.kind == PARTICIPANT:
        return key
    master = document.proxy.master or name
    address = parse_authority(master)
    host = f"{document.proxy.host} " if address and is_loopback(address.host) else ""
    return f"{host}{master} {key}"
