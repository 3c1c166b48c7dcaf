"""Reads from a message of the API server which right is missing."""

import re

_RBAC = re.compile(
    r'cannot (?P<verb>\w+) resource "(?P<resource>[^"]*)" in API group "(?P<group>[^"]*)"'
    r'(?: in the namespace "(?P<namespace>[^"]*)")?'
)


def missing_rule(message: str) -> str:
    """Return the rule that the operator's role lacks; empty if RBAC did not refuse."""
    match = _RBAC.search(message)
    if match is None:
        return ""
    place = f" in the namespace {match['namespace']}" if match["namespace"] else ""
    return (
        f"the operator's role lacks a rule{place}: "
        f'apiGroups ["{match["group"]}"], resources ["{match["resource"]}"], '
        f'verbs ["{match["verb"]}"]'
    )


def missing_right(message: str) -> str:
    """Return the missing right for ``kubectl auth can-i``; empty if RBAC did not refuse."""
    match = _RBAC.search(message)
    if match is None:
        return ""
    group = f".{match['group']}" if match["group"] else ""
    place = f" -n {match['namespace']}" if match["namespace"] else " -A"
    return f"{match['verb']} {match['resource']}{group}{place}"
