"""The key from which the tokens of the proxies' admin endpoints are made: in a Secret, made once.

A proxy's pod holds only the hash of its token, so that whoever may read pods can't change what the
proxy knows. The operator has no disk, and computes each token anew from this key and the proxy's
name (`names.token_of`), as others that stand by do. The chart makes the Secret without data, so
that the right to write is for one name; upgrades leave it alone. Whoever takes the key out of it
gets another one, and the proxies are made anew, one of a RosProxy after the other, on the same
ports.
"""

import base64
import binascii
import logging
import secrets
from collections.abc import Sequence

from rosproxy_operator.common.problem import Problem
from rosproxy_operator.kubernetes.api.client import (
    Api,
    ApiAway,
    ApiConflict,
    ApiError,
    ApiGone,
    ApiInvalid,
)
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.resources.values import part, word

log = logging.getLogger(__name__)

ENTRY = "key"
"""Where it is in the Secret's data."""
LENGTH = 32
"""Bytes of it: those of the hash that it is used with (RFC 2104, section 3)."""


class TokenKey:
    """Reads the key, and makes one where there is none. Without a Secret it is this process's."""

    def __init__(self, api: Api, secret: Name | None) -> None:
        self._api, self._secret = api, secret
        self._own = b""
        self.problems: Sequence[Problem] = ()

    def read(self) -> bytes:
        """The key as it is now. Raises ApiAway."""
        self.problems = ()
        if self._secret is None:
            return self._kept()
        try:
            there = self._api.get("secrets", self._secret)
            found = _read(there)
            if not found:
                found = secrets.token_bytes(LENGTH)
                self._put(self._secret, found, there)
        except ApiAway:
            raise
        except ApiError as error:
            self._complain(error)
            return self._kept()
        self._own = found
        return found

    def _put(self, secret: Name, key: bytes, there: Json) -> None:
        """Write a key into the Secret. Whoever was faster has the right one. Raises ApiError."""
        entries = {ENTRY: base64.b64encode(key).decode()}
        try:
            self._api.fill_secret(secret, there, entries)
        except (ApiInvalid, ApiConflict) as error:
            raise ApiAway(f"somebody else writes {secret}: {error}") from None
        log.info("made a key for the proxies' tokens in Secret %s", secret)

    def _kept(self) -> bytes:
        """The key that was known last, else one that lasts as long as this process."""
        self._own = self._own or secrets.token_bytes(LENGTH)
        return self._own

    def _complain(self, error: ApiError) -> None:
        text = (
            f"Secret {self._secret}: {error}; the key of the proxies' tokens is kept in memory, "
            "and proxies are made anew when the operator starts again"
        )
        if isinstance(error, ApiGone):
            text += ": create an empty Secret of this name (the chart does)"
        self.problems = (Problem("proxies' tokens", text),)


def _read(secret: Json) -> bytes:
    """The key in a Secret; empty if there is none that is long enough."""
    try:
        found = base64.b64decode(word(part(secret, "data"), ENTRY), validate=True)
    except binascii.Error:
        return b""
    return found if len(found) >= LENGTH else b""
