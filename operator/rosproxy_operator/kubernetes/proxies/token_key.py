"""The key of the proxies' tokens. The operator creates the key once, and keeps the key in a Secret.

A proxy's pod has only the hash of the token. So a user that may read pods can't change anything at
the admin endpoint. The operator has no disk, and computes each token from the key, the proxy's name
and the node (`names.token_of`). Operators that stand by compute the same tokens.

The chart creates the Secret without data. So the operator needs the right to write this Secret
only. An upgrade of the chart does not change the Secret. If a user removes the key from the Secret,
the operator creates a new key. Then the operator recreates the proxies of a RosProxy in turn, on
the same ports.
"""

import base64
import binascii
import logging
import secrets
from collections.abc import Sequence

from rosproxy_operator.common.problem import Problem
from rosproxy_operator.kubernetes.api.api_client import (
    Api,
    ApiConflict,
    ApiError,
    ApiInvalid,
    ApiNotFound,
    ApiUnavailable,
)
from rosproxy_operator.kubernetes.resources.checks import submap, text_at
from rosproxy_operator.kubernetes.resources.model import Json, Name

log = logging.getLogger(__name__)

KEY_ENTRY = "key"
"""Name of the key's entry in the Secret's data."""
KEY_BYTES = 32
"""Bytes of the key: the length of a SHA-256 hash (RFC 2104, section 3)."""


class TokenKey:
    """Reads the key from the Secret, or creates a key: without a Secret, in memory only."""

    def __init__(self, api: Api, secret: Name | None) -> None:
        self._api = api
        self._secret = secret
        self._cached_key = b""
        self.problems: Sequence[Problem] = ()

    def read(self) -> bytes:
        """Return the key. Raises ApiUnavailable.

        Other errors of the API server become ``problems``, and the key is in memory only.
        """
        self.problems = ()
        if self._secret is None:
            return self._kept_key()
        try:
            manifest = self._api.get("secrets", self._secret)
            key = _read(manifest)
            if not key:
                key = secrets.token_bytes(KEY_BYTES)
                self._put(self._secret, key, manifest)
        except ApiUnavailable:
            raise
        except ApiError as error:
            self._complain(error)
            return self._kept_key()
        self._cached_key = key
        return key

    def _put(self, secret: Name, key: bytes, manifest: Json) -> None:
        """Write a new key to the Secret. Raises ApiError.

        Raises ApiUnavailable if another program was faster: the next look reads the Secret again.
        """
        entries = {KEY_ENTRY: base64.b64encode(key).decode()}
        try:
            self._api.fill_secret(secret, manifest, entries)
        except (ApiInvalid, ApiConflict) as error:
            raise ApiUnavailable(f"another program has written Secret {secret}: {error}") from None
        log.info("key of the proxies' tokens created: Secret %s", secret)

    def _kept_key(self) -> bytes:
        """Return the last known key, or else a key that only this process has."""
        self._cached_key = self._cached_key or secrets.token_bytes(KEY_BYTES)
        return self._cached_key

    def _complain(self, error: ApiError) -> None:
        text = (
            f"Secret {self._secret}: {error}. The key of the proxies' tokens is in memory only, and"
            " the operator replaces the proxies at its next start"
        )
        is_missing = isinstance(error, ApiNotFound)
        fix = "Create an empty Secret of this name (the chart does so)" if is_missing else ""
        self.problems = (Problem("proxies' tokens", text, fix, reason="KeyNotStored"),)


def _read(secret: Json) -> bytes:
    """Return the key in a Secret, empty if the key is missing, too short, or not base64."""
    try:
        key = base64.b64decode(text_at(submap(secret, "data"), KEY_ENTRY), validate=True)
    except binascii.Error:
        return b""
    return key if len(key) >= KEY_BYTES else b""
