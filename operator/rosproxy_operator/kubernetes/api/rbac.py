"""What the API server says of a right that is missing, in words that help whoever grants it."""

import re

_RBAC = re.compile(
    r'cannot (?P<verb>\w+) resource "(?P<resource>[^"]*)" in API group "(?P<group>[^"]*)"'
    r'(?: in the namespace "(?P<namespace>[^"]*)")?'
)


def missing_rule(message: str) -> str:
    """The rule that the operator's role lacks, by the API server's words; empty if it is none."""
    found = _RBAC.search(message)
    if found is None:
        return ""
    where = f" in the namespace {found['namespace']}" if found["namespace"] else ""
    return (
        f"the operator's role lacks a rule{where}: "
        f'apiGroups ["{found["group"]}"], resources ["{found["resource"]}"], '
        f'verbs ["{found["verb"]}"]'
    )
