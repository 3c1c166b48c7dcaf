"""How a call uses parameters, and so which rules and names the policy checks."""

import msgspec

from rosproxy.ros1.protocol.master_methods import resolve_name
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.shared.policy.rules import RuleKind

_ROOT_NAMESPACE = "/"
_NAME_INDEX_OF_READS = {"getParam": 1, "hasParam": 1, "searchParam": 1, "subscribeParam": 2}
_NAME_INDEX_OF_WRITES = {"setParam": 1, "deleteParam": 1}
"""The position of the parameter's name in the calls that read, and in the calls that write."""
_NAMESPACE_METHODS = frozenset({"getParam", "subscribeParam", "setParam", "deleteParam"})
"""The methods that apply to a whole namespace if the name is a namespace."""


class ParamUse(msgspec.Struct, frozen=True):
    """How a call uses parameters.

    ``kind``: the kind of the rules for the call. ``names``: the names that the call may mean.
    ``below``: whether the call also means all names below ``names``.
    """

    kind: RuleKind
    names: tuple[str, ...]
    below: bool


def param_use(method: str, caller_id: str, name: str | None) -> ParamUse | None:
    """How a call uses parameters; None for a method that names no parameter.

    ``name`` is the name as sent; None if unknown, which stands for all parameters.
    """
    if method not in _NAME_INDEX_OF_READS and method not in _NAME_INDEX_OF_WRITES:
        return None
    kind = RuleKind.SET_PARAM if method in _NAME_INDEX_OF_WRITES else RuleKind.GET_PARAM
    if name is None:
        return ParamUse(kind, (_ROOT_NAMESPACE,), True)
    if method == "searchParam":
        return ParamUse(kind, _searched_names(caller_id, name), False)
    return ParamUse(kind, (resolve_name(name, caller_id),), method in _NAMESPACE_METHODS)


def param_use_of(call: Call) -> ParamUse | None:
    """How a parsed call uses parameters; None for a method that names no parameter."""
    place = _NAME_INDEX_OF_READS.get(call.method) or _NAME_INDEX_OF_WRITES.get(call.method)
    return param_use(call.method, call.string(0) or "", call.string(place)) if place else None


def sets_namespace(call: Call) -> bool:
    """Whether a call sets a whole namespace by a struct. True also for a call without a value."""
    return call.method == "setParam" and (len(call.params) < 3 or call.params[2].kind == "struct")


def _searched_names(caller_id: str, name: str) -> tuple[str, ...]:
    """The names that searchParam tries: below the caller_id, then below each parent namespace."""
    if name.startswith(("/", "~")):
        return (resolve_name(name, caller_id),)
    segments = [segment for segment in caller_id.split("/") if segment]
    namespaces = ("/".join(["", *segments[:count]]) for count in range(len(segments), -1, -1))
    return tuple(resolve_name(f"{namespace}/{name}", "") for namespace in namespaces)
