"""Warnings about misspelt labels and annotations that are meant for the operator.

The webhook does not see a pod with a misspelt label, and no RosProxy selects the pod. So no other
message mentions the pod. The warning suggests the correct name.
"""

from collections.abc import Iterator
from itertools import islice
from typing import Literal, NamedTuple

from rosproxy.shared.output.text import clean, shorten
from rosproxy_operator.common.spelling import LEAST_SIMILARITY, nearest, unknown_name
from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources.checks import texts_at
from rosproxy_operator.kubernetes.resources.model import Json

Kind = Literal["pods", "nodes", "Services of masters", "RosProxies"]


class _KnownName(NamedTuple):
    """A name that users set: a label or an annotation (``place``), and the ``kind`` of object."""

    name: str
    place: str
    kind: Kind

    def __str__(self) -> str:
        return f"the {self.place} {self.name} of {self.kind}"


_NAMES_FOR_USERS = (
    _KnownName(names.INJECT, "label", "pods"),
    _KnownName(names.ADVERTISE_HOST, "annotation", "nodes"),
    _KnownName(names.ALLOW_FROM, "annotation", "Services of masters"),
    _KnownName(names.REMAKE, "annotation", "RosProxies"),
)
_BY_NAME = {named.name: named for named in _NAMES_FOR_USERS}
_BY_END = {named.name.partition("/")[2]: named for named in _NAMES_FOR_USERS}
_LEAST_END_SIMILARITY = 0.6
"""Least similarity (`spelling.nearest`) of the part after the prefix, for a suggestion."""
_NAMES_OF_OPERATOR = frozenset(
    {
        *(names.PROXY_OF, names.NODE, names.PORT_RANGE, names.FINGERPRINT),
        *(names.MASTER_URI, names.REPLACED_URI, names.STATIC_PEERS),
        *(names.DOMAIN, names.ROUTER_ENDPOINT, names.NOT_WIRED_BECAUSE),
    }
)
"""Names that the operator sets. Users may copy such names, since some are in users' pods."""
_PREFIXES = (f"{names.GROUP}/", "rosproxy.", "rosproxy/")
_PLACES = {"label": "labels", "annotation": "annotations"}
MOST_MISSPELT_NAMES = 3
"""Misspelt names that are reported for an object."""
MOST_CHECKED_NAMES = 256
"""Labels of an object that are checked, and as many annotations. Each check takes 30 us."""


def misspelt_names(metadata: Json, kind: Kind) -> tuple[str, ...]:
    """Return a warning for each misspelt name of an object, for at most `MOST_MISSPELT_NAMES`.

    Empty for an object that the operator has created.
    """
    if names.is_own(texts_at(metadata, "labels")):
        return ()
    return tuple(islice(_texts(metadata, kind), MOST_MISSPELT_NAMES))


def _texts(metadata: Json, kind: Kind) -> Iterator[str]:
    for place, key in _PLACES.items():
        own_first = sorted(texts_at(metadata, key), key=lambda name: (not _is_ours(name), name))
        for name in own_first[:MOST_CHECKED_NAMES]:
            named = _BY_NAME.get(name)
            if name in _NAMES_OF_OPERATOR or (named and (named.place, named.kind) == (place, kind)):
                continue
            shown = f"{place} {shorten(clean(name), 100)}"
            if named:
                yield f"{shown} is ignored here. The operator reads only {named}"
            elif _is_ours(name) or nearest(name, tuple(_BY_NAME), LEAST_SIMILARITY):
                yield unknown_name(shown, *_suggestion(name, kind))


def _is_ours(name: str) -> bool:
    """Whether a name begins like the names of the operator."""
    return name.lower().startswith(_PREFIXES)


def _suggestion(name: str, kind: Kind) -> tuple[str, str]:
    """Return the name that is probably meant, or an empty text, and all names of the kind."""
    # Only the part after the prefix is compared, because all names have the same prefix.
    _, slash, last = name.rpartition("/")
    near = nearest(last if slash else name.partition(".")[2], tuple(_BY_END), _LEAST_END_SIMILARITY)
    known = " and ".join(str(named) for named in _NAMES_FOR_USERS if named.kind == kind)
    return str(_BY_END[near]) if near else "", known
