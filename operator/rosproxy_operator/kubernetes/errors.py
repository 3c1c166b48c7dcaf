"""What can go wrong with the API server, and what to do about it, in one line."""

import json
import re
from enum import Enum

_RBAC = re.compile(
    r'cannot (?P<verb>\w+) resource "(?P<resource>[^"]*)" in API group "(?P<group>[^"]*)"'
    r'(?: in the namespace "(?P<namespace>[^"]*)")?'
)
_TERMINATING = "because it is being terminated"
"""What the admission plug-in NamespaceLifecycle says of a namespace that is being deleted."""
_TEST_FAILED = "the server rejected our request due to an error in our request"
"""All that the API server says when a ``test`` of a JSON patch fails."""
_LONGEST = 500


class ErrorKind(Enum):
    """Why the API server did not do what it was asked, as far as that makes a difference."""

    AWAY = "away"  # it can't be reached, or is not ready to answer
    DENIED = "denied"  # a rule is missing in the operator's role
    GONE = "gone"
    CONFLICT = "conflict"  # the name is taken, or the object is another one by now
    INVALID = "invalid"  # the object is not one that the API server takes
    OTHER = "other"


_KINDS = {
    400: ErrorKind.INVALID,
    401: ErrorKind.AWAY,  # the token has just been replaced, or the server does not know it yet
    404: ErrorKind.GONE,
    409: ErrorKind.CONFLICT,
    422: ErrorKind.INVALID,
    429: ErrorKind.AWAY,
}


class ApiError(Exception):
    """The API server did not do what it was asked; the message is one line."""

    def __init__(self, kind: ErrorKind, text: str) -> None:
        super().__init__(text)
        self.kind, self.text = kind, text


def refusal(status: int, reason: str, body: bytes) -> ApiError:
    """The error for what the API server answered: HTTP status, reason phrase, body."""
    message = _message(body) or reason
    if status == 403:
        return _forbidden(message)
    if status == 401:
        message = f"the API server does not know the operator's token or certificate ({message})"
    elif status >= 500 or status == 429:
        message = f"the API server answers HTTP {status}: {message}"
        return ApiError(ErrorKind.AWAY, message)
    elif status == 422 and message == _TEST_FAILED:
        return ApiError(ErrorKind.CONFLICT, "the object has changed meanwhile")
    return ApiError(_KINDS.get(status, ErrorKind.OTHER), message)


def unreachable(server: str, error: BaseException) -> ApiError:
    """The error for an API server that can't be asked."""
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return ApiError(ErrorKind.AWAY, f"the API server at {server} can't be reached: {reason}")


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


def _forbidden(message: str) -> ApiError:
    """Why it is forbidden: by a role, or by an admission plug-in that has looked at the object."""
    if _TERMINATING in message:
        return ApiError(ErrorKind.GONE, message)
    rule = missing_rule(message)
    if rule:
        return ApiError(ErrorKind.DENIED, f"{rule} ({message})")
    return ApiError(ErrorKind.INVALID, message)


def _message(body: bytes) -> str:
    """The message of the ``Status`` object with which the API server refuses."""
    text = body.decode(errors="replace")
    try:
        found = json.loads(text)
        text = str(found["message"])
    except (ValueError, KeyError, TypeError):
        pass
    return " ".join(text.split())[:_LONGEST]
