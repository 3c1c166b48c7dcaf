"""The key from which the tokens of the proxies' admin endpoints are made: in a Secret, made once.

A proxy's pod holds only the hash of its token, so that whoever may read pods can't change what the
proxy knows. The operator has no disk, and computes each token anew from this key and the proxy's
name (`names.token_of`), as operators that stand by do. The chart makes the Secret without data, so
that the right to write is for one name; upgrades leave it alone. If the key is removed from it,
another one is made, and the proxies are made anew, one of a RosProxy after the other, on the same
ports.
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

ENTRY = "key"
"""The key's name in the Secret's data."""
LENGTH = 32
"""Bytes of the key: as many as those of the hash that it is used with (RFC 2104, section 3)."""


class TokenKey:
    """Reads the key, and makes one where there is none. Without a Secret it is this process's."""

    def __init__(self, api: Api, secret: Name | None) -> None:
        self._api = api
        self._secret = secret
        self._cached_key = b""
        self.problems: Sequence[Problem] = ()

    def read(self) -> bytes:
        """The key as it is now. Raises ApiUnavailable."""
        self.problems = ()
        if self._secret is None:
            return self._kept_key()
        try:
            manifest = self._api.get("secrets", self._secret)
            key = _read(manifest)
            if not key:
                key = secrets.token_bytes(LENGTH)
                self._put(self._secret, key, manifest)
        except ApiUnavailable:
            raise
        except ApiError as error:
            self._complain(error)
            return self._kept_key()
        self._cached_key = key
        return key

    def _put(self, secret: Name, key: bytes, manifest: Json) -> None:
        """Write a key to the Secret; a key of a faster operator counts. Raises ApiError."""
        entries = {ENTRY: base64.b64encode(key).decode()}
        try:
            self._api.fill_secret(secret, manifest, entries)
        except (ApiInvalid, ApiConflict) as error:
            raise ApiUnavailable(f"another program has written Secret {secret}: {error}") from None
        log.info("key of the proxies' tokens created: Secret %s", secret)

    def _kept_key(self) -> bytes:
        """The key that was known last, else one that lasts as long as this process."""
        self._cached_key = self._cached_key or secrets.token_bytes(LENGTH)
        return self._cached_key

    def _complain(self, error: ApiError) -> None:
        text = (
            f"Secret {self._secret}: {error}. The key of the proxies' tokens is in memory only, and"
            " the operator replaces the proxies at its next start"
        )
        if isinstance(error, ApiNotFound):
            text += ". Create an empty Secret of this name (the chart does so)"
        self.problems = (Problem("proxies' tokens", text),)


def _read(secret: Json) -> bytes:
    """The key in a Secret; empty if there is none that is long enough."""
    try:
        key = base64.b64decode(text_at(submap(secret, "data"), ENTRY), validate=True)
    except binascii.Error:
        return b""
    return key if len(key) >= LENGTH else b""
