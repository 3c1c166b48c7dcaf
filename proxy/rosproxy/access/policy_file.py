"""The file of ``--policy-file``: rules, a line each, read again when it changes.

A file that can't be read or holds a mistake leaves the rules in force that it had before, and is a
problem in the status until it is mended.
"""

import logging
import os
from pathlib import Path

from rosproxy.access.access_policy import AccessPolicy
from rosproxy.access.layers import PolicyLayer, PolicyMode
from rosproxy.access.rules import parse_rules
from rosproxy.telemetry.problems import Problems

log = logging.getLogger(__name__)

LOOK_INTERVAL = 1.0
"""Seconds between looks whether the file has changed."""
LONGEST_FILE = 1024 * 1024
"""Bytes of the file that are read at most."""
OPTION = "--policy-file"


class PolicyFile:
    """The file, and its signature when it was read last."""

    def __init__(
        self, path: str, mode: PolicyMode, policy: AccessPolicy, problems: Problems
    ) -> None:
        self._path = Path(path)
        self._mode = mode
        self._policy = policy
        self._problems = problems
        self._last_signature: tuple[int, ...] | None = None

    def read(self) -> None:
        """Take in what the file says. Raises ValueError, which says what is wrong with it."""
        try:
            with self._path.open("rb") as file:
                # Taken first: what changes while it is read is read at the next look.
                self._last_signature = _signature(os.fstat(file.fileno()))
                text = file.read(LONGEST_FILE + 1)
            if len(text) > LONGEST_FILE:
                raise ValueError(f"{self._path} is longer than {LONGEST_FILE} bytes")
            rules = parse_rules(text.decode())
        except OSError as error:
            raise ValueError(f"{self._path} can't be read: {error.strerror}") from None
        except UnicodeDecodeError:
            raise ValueError(f"{self._path} is not UTF-8 text") from None
        self._policy.use_file(PolicyLayer(f"{OPTION} {self._path}", rules, self._mode))

    async def look(self) -> None:
        """Read the file again if it has changed."""
        try:
            if _signature(self._path.stat()) == self._last_signature:
                return
        except OSError:
            self._last_signature = None
        try:
            self.read()
        except ValueError as error:
            text = f"{error}. The rules that were read before stay in force"
            # A file that can't be opened is tried at each look, and told of once.
            if text not in (problem.text for problem in self._problems.all()):
                log.error("%s: %s", OPTION, text)
                self._problems.solved(OPTION)
                self._problems.add(OPTION, text, holds=True)
        else:
            log.info("%s %s was read again", OPTION, self._path)
            self._problems.solved(OPTION)


def _signature(stat: os.stat_result) -> tuple[int, ...]:
    """What differs once the file has changed, or another file has its name."""
    return stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns
