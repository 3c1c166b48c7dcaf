"""Merges the live pages of several proxies into a single document.

Each proxy has its own nodes inside. All proxies of a master have the same nodes outside, so the
merged page shows each node and each link once. A node outside one proxy may be inside another. A
master on loopback is a different master on each host. A participant of ROS 2 has the same key at
all proxies: the domain and the unique GUID prefix. The same holds for a node of rmw_zenoh, whose
key has the domain and the zenoh ID of its session. If a proxy does not answer, the page shows the
proxy as a node with the reason. The problems that the operator finds by itself are findings, too.

An attacker may control a proxy. So each proxy gets a fair share of the nodes, links and findings.
The operator shortens all texts as a proxy of this release does. A proxy can't forge the key of
another proxy or of a node inside another proxy. The operator drops a link if neither end is inside
the proxy that reports the link.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Set
from itertools import islice
from operator import itemgetter
from types import MappingProxyType
from typing import Any, TypeVar

import msgspec
from msgspec.structs import replace

from rosproxy.page.page_document import (
    BROKEN,
    CONTAINER,
    HOST,
    MOST_FINDINGS,
    MOST_LINKS,
    MOST_NODES,
    OK,
    WARNING,
    Document,
    PageFinding,
    PageLink,
    PageNode,
    PageProxy,
    shown_name,
    shown_text,
    within_bounds,
)
from rosproxy.page.zenoh_graph import HUB, NODE, ROUTER
from rosproxy.shared.addresses import (
    is_loopback,
    parse_authority,
    parse_host_port,
    plain_address,
)
from rosproxy.shared.documents.status_bounds import fair_choice, fair_shares
from rosproxy.shared.output.text import plural
from rosproxy_operator.common.problem import SILENT, Problem

Json = dict[str, Any]
PROXY = "proxy"
PARTICIPANT = "participant"
"""Kinds of nodes on the page (`PageNode.kind`)."""
_SHARED_KINDS = frozenset({PARTICIPANT, NODE, ROUTER, HUB})
"""Kinds of nodes with the same key at all proxies."""
_OPERATOR = ""
"""The owner of the operator's own findings, in place of the name of a proxy."""
_LONG_TEXT_FIELDS = ("text", "fix", "detail")
_MOST_LEFT_OUT = 10**9
Row = TypeVar("Row", PageNode, PageLink, PageFinding, PageProxy)
_RANKS = {WARNING: 1, BROKEN: 2}
"""The severity of a state. All other states have rank 0."""


def read_document(text: str) -> Document:
    """Parse and shorten the document in a proxy's answer. Raises ValueError."""
    try:
        document = msgspec.json.decode(text, type=Document)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(str(error)) from None
    return _shortened(document)


def merged(
    documents: Mapping[str, Document | str],
    version: str,
    logs: Callable[[str], str],
    places: Mapping[str, str] = MappingProxyType({}),
    problems: Mapping[Problem, float] = MappingProxyType({}),
) -> Json:
    """Return a single document from the documents of all proxies.

    ``documents`` has a document for each proxy name, or a text that says why the proxy does not
    answer. ``logs`` returns the command that shows the logs of a proxy. ``places`` has the names of
    containers or pods inside, by address. ``problems`` are the problems of the operator, with the
    Unix times at which the operator first saw the problems.
    """
    nodes: dict[str, PageNode] = {}
    links: dict[str, PageLink] = {}
    silent = _silent(documents, problems)
    findings = [*_own_findings(problems, silent.values())]
    shares = _shares(documents)
    left_out = sum(_size(whole) - _size(shares[name]) for name, whole in documents.items())
    documents = shares
    inside = _inside(documents)
    for name, document in documents.items():
        if isinstance(document, str):
            problem = silent.get(name, Problem(name, document, logs(name), reason=SILENT))
            nodes[name] = _silent_proxy(name, problem, problems.get(problem))
            continue
        others = documents.keys() - {name}
        page_keys = {
            key: _key(name, document, key, node, others) for key, node in document.nodes.items()
        }
        for key, node in document.nodes.items():
            if node.lane != CONTAINER and page_keys[key] in inside:
                page_keys[key] = inside[page_keys[key]]  # the proxy with the node inside knows more
                continue
            known = nodes.get(page_keys[key])
            if known and _RANKS.get(known.state, 0) > _RANKS.get(node.state, 0):
                continue  # an earlier proxy reports a worse state
            nodes[page_keys[key]] = _placed(name, key, node, places)
        for link in _own_links(name, document, page_keys):
            links[link.key] = max(links.get(link.key, link), link, key=_report_rank)
        findings += ((name, replace(f, subject=f"{name}: {f.subject}")) for f in document.findings)
        left_out += document.left_out
    shown, kept = within_bounds(nodes, links)
    shown_findings = fair_choice(findings, itemgetter(0), MOST_FINDINGS)
    return {
        "proxy": {"host": plural(len(documents), "proxy"), "version": version},
        "nodes": msgspec.to_builtins(shown),
        "links": msgspec.to_builtins(kept),
        "findings": msgspec.to_builtins([f for _, f in shown_findings]),
        "left_out": left_out + len(nodes) - len(shown) + len(links) - len(kept),
    }


def _silent(
    documents: Mapping[str, Document | str], problems: Iterable[Problem]
) -> dict[str, Problem]:
    """Return the operator's problems about proxies that do not answer, by proxy name.

    The page shows such a problem at the proxy, because a finding would repeat the fault.
    """
    return {
        name: problem
        for name, reason in documents.items()
        if isinstance(reason, str)
        for problem in problems
        if problem.subject.startswith("proxy ") and reason in problem.text
    }


def _silent_proxy(name: str, problem: Problem, since: float | None) -> PageNode:
    text = shown_text(f"no data from this proxy: {problem.text}")
    wrong_since = None if since is None else round(since)
    return PageNode(HOST, PROXY, name, BROKEN, text, problem.fix, wrong_since=wrong_since)


def _own_findings(
    problems: Mapping[Problem, float], shown: Collection[Problem]
) -> Iterator[tuple[str, PageFinding]]:
    """Yield the operator's problems as findings, fatal problems first, each with the owner.

    Without the problems that the page has ``shown`` already.
    """
    left = [problem for problem in problems if problem not in shown]
    for problem in sorted(left, key=lambda p: not p.fatal):
        severity = "error" if problem.fatal else "warning"
        subject = shown_name(problem.subject)
        texts = (shown_text(problem.text), shown_text(problem.fix))
        wrong_since = round(problems[problem])
        yield _OPERATOR, PageFinding(severity, subject, *texts, wrong_since=wrong_since)


def _placed(name: str, key: str, node: PageNode, places: Mapping[str, str]) -> PageNode:
    """Return a node of the proxy ``name`` with the label, the proxy and the place on the page.

    A participant without known nodes gets the name of its container or pod as its label. A node
    outside has no proxy and no place. The operator ignores places that a proxy reports.
    """
    label = name if node.kind == PROXY else node.label or key
    if node.lane != CONTAINER:
        return replace(node, label=label, proxy="", place="")
    text = node.address.partition(",")[0]
    host_port = parse_host_port(text)
    address = host_port.host if host_port else text
    place = shown_name(places.get(plain_address(address), ""))
    if place and node.kind == PARTICIPANT and label.startswith(address):
        label = place + label.removeprefix(address)
    return replace(node, label=label, proxy=name, place=place)


def _shortened(document: Document) -> Document:
    """Return the document with texts and numbers within the bounds of a proxy of this release."""
    nodes = islice(document.nodes.items(), 2 * MOST_NODES)
    links = islice(document.links.items(), 2 * MOST_LINKS)
    proxy = document.proxy
    return replace(
        document,
        nodes={shown_name(key): _with_short_texts(node) for key, node in nodes},
        links={shown_name(key): _with_short_texts(link) for key, link in links},
        findings=tuple(_with_short_texts(finding) for finding in document.findings[:MOST_FINDINGS]),
        proxy=_with_short_texts(proxy),
        left_out=min(max(document.left_out, 0), _MOST_LEFT_OUT),
    )


def _with_short_texts(row: Row) -> Row:
    """Return the row with shortened texts."""
    texts = {
        name: (shown_text if name in _LONG_TEXT_FIELDS else shown_name)(text)
        for name in row.__struct_fields__
        if isinstance(text := getattr(row, name), str)
    }
    return replace(row, **texts)


def _shares(documents: Mapping[str, Document | str]) -> dict[str, Document | str]:
    """Return the documents, each cut to the proxy's fair share of nodes and links."""
    read = {name: d for name, d in documents.items() if not isinstance(d, str)}
    nodes = fair_shares([len(document.nodes) for document in read.values()], MOST_NODES)
    links = fair_shares([len(document.links) for document in read.values()], MOST_LINKS)
    shares: dict[str, Document | str] = {**documents}
    for (name, document), *share in zip(read.items(), nodes, links, strict=True):
        kept_nodes, kept_links = within_bounds(document.nodes, document.links, *share)
        shares[name] = replace(document, nodes=kept_nodes, links=kept_links)
    return shares


def _size(document: Document | str) -> int:
    """Return the number of nodes and links in a document."""
    return 0 if isinstance(document, str) else len(document.nodes) + len(document.links)


def _report_rank(link: PageLink) -> tuple[int, bool, bool]:
    """Return the rank of a proxy's report of a link. The page shows the report of highest rank.

    A worse state ranks higher. OK ranks above unknown. Then a report with a port ranks higher.
    """
    return _RANKS.get(link.state, 0), link.state == OK, link.port is not None


def _inside(documents: Mapping[str, Document | str]) -> dict[str, str]:
    """Return the page keys of all nodes inside, by the page keys of the same nodes as outside."""
    return {
        _outside_key(name, document, key, node, documents.keys() - {name}): f"{name} {key}"
        for name, document in documents.items()
        if not isinstance(document, str)
        for key, node in document.nodes.items()
        if node.lane == CONTAINER
    }


def _key(name: str, document: Document, key: str, node: PageNode, others: Set[str]) -> str:
    """Return the key of a node on the page. A node outside has the same key at all proxies."""
    if node.lane == CONTAINER or node.kind == PROXY:
        return f"{name} {key}"
    return _outside_key(name, document, key, node, others)


def _outside_key(name: str, document: Document, key: str, node: PageNode, others: Set[str]) -> str:
    """Return the key that a node has on the page as a node outside.

    ``others`` are the names of the other proxies. If the key would begin with one of them, ``name``
    is put in front. So a proxy can't forge a key of another proxy.
    """
    outside_key = key
    # A router at a loopback address is a different router on each host.
    if node.kind not in _SHARED_KINDS or (node.kind == ROUTER and node.lane == HOST):
        master = document.proxy.master or name
        address = parse_authority(master)
        host = f"{document.proxy.host} " if address and is_loopback(address.host) else ""
        outside_key = f"{host}{master} {key}"
    return f"{name} {outside_key}" if _first_word(outside_key) in others else outside_key


def _own_links(name: str, document: Document, page_keys: Mapping[str, str]) -> Iterator[PageLink]:
    """Yield the links of a document with an end inside the proxy ``name``.

    ``page_keys`` has the key on the page for each key in the document. A proxy of this release
    shows no other links (`rosproxy.page.graph_document`). Each link with a port gets the key of the
    proxy's own node, if the document has this node.
    """
    carriers = (page_keys[key] for key, node in document.nodes.items() if node.kind == PROXY)
    carrier = next(carriers, "")
    for link in document.links.values():
        source = page_keys.get(link.source)
        target = page_keys.get(link.target) if link.target else ""
        if source is None or target is None:
            continue
        if name in (_first_word(source), _first_word(target)):
            proxy = carrier if link.port else ""
            yield replace(link, source=source, target=target, proxy=proxy)


def _first_word(key: str) -> str:
    """Return the first word of a key: for a proxy or a node inside, the name of the proxy."""
    return key.partition(" ")[0]
