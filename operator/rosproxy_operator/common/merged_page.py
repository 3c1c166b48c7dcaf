"""The live pages of several proxies as one document.

Inside is each proxy's own. Outside is the same for all that have one master, so that its nodes
stand there once. A proxy that can't be asked is a box that says why.
"""

from collections.abc import Mapping
from typing import Any

import msgspec
from msgspec.structs import replace

from rosproxy.page.document import (
    BROKEN,
    CONTAINER,
    HOST,
    MOST_FINDINGS,
    MOST_LINKS,
    MOST_NODES,
    Document,
    PageLink,
    PageNode,
    Told,
)

Json = dict[str, Any]
PROXY = "proxy"


def read_document(text: str) -> Document:
    """The document in a proxy's answer. Raises ValueError."""
    try:
        return msgspec.json.decode(text, type=Document)
    except msgspec.DecodeError as error:
        raise ValueError(str(error)) from None


def merged(found: Mapping[str, Document | str], version: str) -> Json:
    """One document of those of proxies, by their names; a text is why one can't be asked."""
    nodes: dict[str, PageNode] = {}
    links: list[tuple[str, PageLink]] = []
    findings: list[Told] = []
    left_out = 0
    for name, one in found.items():
        if isinstance(one, str):
            nodes[name] = PageNode(HOST, PROXY, name, BROKEN, f"it can't be asked: {one}")
            continue
        names = {key: _key(name, one, key, node) for key, node in one.nodes.items()}
        for key, node in one.nodes.items():
            label = name if node.kind == PROXY else node.label or key
            owner = name if node.lane == CONTAINER else ""
            nodes[names[key]] = replace(node, label=label, proxy=owner)
        for link in one.links.values():
            if link.source in names and (not link.target or link.target in names):
                target = names.get(link.target, "")
                links.append((name, replace(link, source=names[link.source], target=target)))
        findings += (replace(told, subject=f"{name}: {told.subject}") for told in one.findings)
        left_out += one.left_out
    links.sort(key=lambda each: (each[1].state != BROKEN, each[1].quiet))
    shown = dict(list(nodes.items())[:MOST_NODES])
    kept = [each for each in links if each[1].source in shown][:MOST_LINKS]
    return {
        "proxy": {"host": f"{len(found)} proxies", "version": version},
        "nodes": msgspec.to_builtins(shown),
        "links": {f"{name} {link.key}": msgspec.to_builtins(link) for name, link in kept},
        "findings": msgspec.to_builtins(findings[:MOST_FINDINGS]),
        "left_out": left_out + len(nodes) - len(shown) + len(links) - len(kept),
    }


def _key(name: str, document: Document, key: str, node: PageNode) -> str:
    """What tells a node from those of other proxies, unless it is the same one outside."""
    if node.lane == CONTAINER or node.kind == PROXY or not document.proxy.master:
        return f"{name} {key}"
    return f"{document.proxy.master} {key}"
