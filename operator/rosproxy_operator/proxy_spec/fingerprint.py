"""Fingerprints. If the fingerprint differs, the operator recreates the container or pod."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from rosproxy.shared import fixes
from rosproxy_operator.proxy_spec.environment import variable

LIVE_VARIABLES = frozenset({fixes.VARIABLE, *map(variable, ("await_policy", "policy_layers"))})
"""Variables that no fingerprint contains: a change of these recreates no proxy.

A running proxy gets a new policy from the operator, without a restart. The name of the operator
only selects the words of fixes (`rosproxy.shared.fixes`).
"""


def digest(body: Mapping[str, Any]) -> str:
    """The fingerprint of a JSON object for the engine: 16 hex digits of SHA-256."""
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()[:16]
