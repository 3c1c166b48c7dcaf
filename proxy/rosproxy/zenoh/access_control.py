"""The access control of a router, for zenoh's configuration.

At the router of a container, the access control filters what passes between the router and the hub,
so that other containers and outside get and see nothing that the policy denies. The nodes of the
container reach each other. Nodes connect by TCP, and the hub by a socket of the file system. The
router distinguishes both by the protocol of the link. At the router of the links to other sites,
the access control filters what passes by TLS and QUIC.

As in DDS, a denied topic or service is hidden from both sides: the subscription of a node outside
is hidden from a publisher inside that may not publish to outside.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.policy.rules import RuleKind
from rosproxy.shared.setting_kinds import LINK_PROTOCOLS
from rosproxy.shared.zenoh_rules.key_expressions import data_keys, in_cache, token_key
from rosproxy.shared.zenoh_rules.name_sets import ALL_NAMES, KINDS, NameSet, allowed_names
from rosproxy.zenoh.protocol.liveliness import EntityKind

HUB_PROTOCOL = "unixsock-stream"
"""The protocol of the links between the hub and the routers of containers."""
NODE_PROTOCOL = "tcp"
_Protocols = tuple[tuple[str, ...], tuple[str, ...]]
_AT_CONTAINER: _Protocols = ((NODE_PROTOCOL,), (HUB_PROTOCOL,))
AT_LINKS: _Protocols = ((HUB_PROTOCOL,), LINK_PROTOCOLS)
"""Where the access control of the links to other sites checks nothing, and where it checks."""
_ALL_KEYS = ("**", "**/@adv/**", "@ros2_lv/**")
_INTERESTS = ("declare_liveliness_subscriber", "liveliness_query")
"""Questions for tokens. The router checks the tokens in the answers."""
_EVERY_MESSAGE = (
    *("put", "delete", "query", "reply", "declare_subscriber", "declare_queryable"),
    *("liveliness_token", *_INTERESTS),
)
_IN = "ingress"
_OUT = "egress"


class _Check(NamedTuple):
    """Messages that a rule checks. ``flow`` is the direction: ingress or egress of the router."""

    messages: tuple[str, ...]
    flow: str


class _Kind(NamedTuple):
    """What a kind of rules checks: data, latched topics, and tokens of both sides.

    ``of_cache`` has the checks for latched topics by the owner of the key: ``pub`` or ``sub``.
    Readers ask for the keys of both, so a question has ``**`` in this place (zenoh-ext,
    advanced_subscriber.rs).

    ``inside`` is the kind of the tokens of nodes inside. ``outside`` is the kind of the tokens of
    the nodes outside that the nodes inside would find.
    """

    of_data: tuple[_Check, ...]
    of_cache: Mapping[str, _Check]
    inside: EntityKind
    outside: EntityKind


_PUTS = ("put", "delete")
_READS = ("query", "declare_subscriber")
_CACHE = ("put", "delete", "declare_queryable", "liveliness_token")
_MESSAGES = {
    RuleKind.PUBLISH: _Kind(
        (_Check(_PUTS, _OUT), _Check(("declare_subscriber",), _IN)),
        {
            "pub": _Check(_CACHE, _OUT),
            "sub": _Check(_CACHE, _IN),
            "**": _Check(_READS, _IN),
        },
        EntityKind.PUBLISHER,
        EntityKind.SUBSCRIPTION,
    ),
    RuleKind.SUBSCRIBE: _Kind(
        (_Check(_PUTS, _IN), _Check(("declare_subscriber",), _OUT)),
        {
            "pub": _Check(_CACHE, _IN),
            "sub": _Check(_CACHE, _OUT),
            "**": _Check(_READS, _OUT),
        },
        EntityKind.SUBSCRIPTION,
        EntityKind.PUBLISHER,
    ),
    RuleKind.SERVE: _Kind(
        (_Check(("query",), _IN), _Check(("declare_queryable",), _OUT)),
        {},
        EntityKind.SERVICE,
        EntityKind.SERVICE_CLIENT,
    ),
    RuleKind.CALL: _Kind(
        (_Check(("query",), _OUT), _Check(("declare_queryable",), _IN)),
        {},
        EntityKind.SERVICE_CLIENT,
        EntityKind.SERVICE,
    ),
}


_SEEN_FROM_OUTSIDE = {
    RuleKind.PUBLISH: RuleKind.SUBSCRIBE,
    RuleKind.SUBSCRIBE: RuleKind.PUBLISH,
    RuleKind.SERVE: RuleKind.CALL,
    RuleKind.CALL: RuleKind.SERVE,
}
"""What nodes outside do with a name about which a rule allows or denies nodes inside something."""


def access_control(
    layers: Sequence[PolicyLayer],
    protocols: _Protocols = _AT_CONTAINER,
    *,
    outside: bool = False,
) -> dict[str, Any] | None:
    """The value ``access_control`` for a router; None if the layers deny nothing.

    ``protocols``: the protocols without checks, by which the nodes of the router come, and those
    with checks. With ``outside``, the nodes of the router are outside: what containers may publish,
    these nodes may subscribe to, and so on. Raises ValueError as `check_layers` does.
    """
    names = {
        _SEEN_FROM_OUTSIDE[kind] if outside else kind: allowed_names(layers, kind) for kind in KINDS
    }
    if all(allowed == ALL_NAMES for allowed in names.values()):
        return None
    free, checked = protocols
    rules = [
        _rule("nodes", _EVERY_MESSAGE, (_IN, _OUT), _ALL_KEYS),
        _rule("interests", _INTERESTS, (_IN, _OUT), _ALL_KEYS),
        # A reply passes only to a query that has passed.
        _rule("replies", ("reply",), (_IN, _OUT), _ALL_KEYS),
        _rule("node names", ("liveliness_token",), (_IN, _OUT), ["@ros2_lv/*/*/*/*/NN/*/*/*"]),
    ]
    for kind, allowed in names.items():
        rules += _rules(kind, allowed)
    of_hub = [rule["id"] for rule in rules[1:]]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [
            {"id": "nodes", "link_protocols": [*free]},
            {"id": "hub", "link_protocols": [*checked]},
        ],
        "policies": [
            {"rules": ["nodes"], "subjects": ["nodes"]},
            {"rules": of_hub, "subjects": ["hub"]},
        ],
    }


def _rules(kind: RuleKind, names: NameSet) -> list[dict[str, Any]]:
    """The rules for the hub about one kind."""
    rules = _rules_about(kind, names.allowed, "allow")
    return rules + _rules_about(kind, names.denied, "deny") if names.denied else rules


def _rules_about(
    kind: RuleKind, globs: Sequence[str] | None, permission: str
) -> list[dict[str, Any]]:
    """Rules that allow or deny the names of globs; None: all keys, also keys without a name."""
    if globs is not None and not globs:
        return []
    about = _MESSAGES[kind]
    data = ["**"] if globs is None else [key for glob in globs for key in data_keys(glob)]
    keyed = [(data, check) for check in about.of_data]
    for owner, check in about.of_cache.items():
        keyed.append((_cache_keys(globs, owner), check))
    for entity, flow in ((about.inside, _OUT), (about.outside, _IN)):
        tokens = [token_key(glob, entity.value) for glob in globs or ("*",)]
        keyed.append((tokens, _Check(("liveliness_token",), flow)))
    return [
        _rule(f"{permission} {kind.value} {number}", c.messages, [c.flow], keys, permission)
        for number, (keys, c) in enumerate(keyed)
    ]


def _cache_keys(globs: Sequence[str] | None, owner: str) -> list[str]:
    if globs is None:
        return [in_cache("**", owner)]
    return [in_cache(key, owner) for glob in globs for key in data_keys(glob)]


def _rule(
    title: str,
    messages: Iterable[str],
    flows: Iterable[str],
    keys: Iterable[str],
    permission: str = "allow",
) -> dict[str, Any]:
    return {
        "id": title,
        "messages": [*messages],
        "flows": [*flows],
        "permission": permission,
        "key_exprs": [*dict.fromkeys(keys)],
    }
