"""Reads the missing right from a message of the API server, for users that grant the right."""

import re

_RBAC = re.compile(
    r'cannot (?P<verb>\w+) resource "(?P<resource>[^"]*)" in API group "(?P<group>[^"]*)"'
    r'(?: in the namespace "(?P<namespace>[^"]*)")?'
)


def missing_rule(message: str) -> str:
    """The rule that the operator's role lacks, by the API server's words; empty if it is none."""
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
    """The right that the caller lacks, as ``kubectl auth can-i`` takes it; else empty."""
    match = _RBAC.search(message)
    if match is None:
        return ""
    group = f".{match['group']}" if match["group"] else ""
    place = f" -n {match['namespace']}" if match["namespace"] else " -A"
    return f"{match['verb']} {match['resource']}{group}{place}"
