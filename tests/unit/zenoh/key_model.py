"""A model of zenoh's key expressions: does an expression include a key without wildcards?"""

import re
from collections.abc import Iterable, Mapping
from typing import Any


def includes(expression: str, key: str) -> bool:
    """Whether a key expression includes a key."""
    pattern = ""
    for chunk in expression.split("/"):
        if chunk == "**":
            pattern += "(?:/[^/@][^/]*)*"
        elif chunk == "*":
            pattern += "/[^/@][^/]*"
        else:
            pattern += "/" + ".*".join(map(re.escape, chunk.split("$*"))).replace(".*", "[^/]*")
    return re.fullmatch(pattern, f"/{key}") is not None


def permits(access: Mapping[str, Any], message: str, flow: str, key: str, subject: str) -> bool:
    """Whether access control permits a message: a rule allows the message, and none denies it."""
    ids = {i for p in access["policies"] if subject in p["subjects"] for i in p["rules"]}
    rules = [rule for rule in access["rules"] if rule["id"] in ids]
    found = {rule["permission"] for rule in rules if _is_about(rule, message, flow, key)}
    return found == {"allow"}


def _is_about(rule: Mapping[str, Any], message: str, flow: str, key: str) -> bool:
    keys: Iterable[str] = rule["key_exprs"]
    is_of_message = message in rule["messages"] and flow in rule["flows"]
    return is_of_message and any(includes(expression, key) for expression in keys)
