"""What says that something has to be made anew: another fingerprint of what it is made of."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from rosproxy import fixes
from rosproxy_operator.proxy_spec.environment import variable

LIVE_VARIABLES = frozenset({fixes.VARIABLE, *map(variable, ("await_policy", "policy_layers"))})
"""Variables in no fingerprint: a running proxy is told a new policy, and the operator's name only
words the fixes of the proxy."""


def digest(body: Mapping[str, Any]) -> str:
    """The fingerprint of an object as the engine takes it, 16 hex digits."""
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()[:16]
