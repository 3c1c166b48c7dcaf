"""The file of ``--policy-file``: a rule on each line. The proxy reads the file when it changes.

If the file can't be read or has a mistake, the rules that were read before stay in force, and the
status has a problem until the file is correct.
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
"""Seconds between checks whether the file has changed."""
LONGEST_FILE = 1024 * 1024
"""Bytes that the file has at most."""
OPTION = "--policy-file"


class PolicyFile:
    """The policy file, and the signature that the file had at the last read."""

    def __init__(
        self, path: str, mode: PolicyMode, policy: AccessPolicy, problems: Problems
    ) -> None:
        self._path = Path(path)
        self._mode = mode
        self._policy = policy
        self._problems = problems
        self._last_signature: tuple[int, ...] | None = None

    def read(self) -> None:
        """Put the rules of the file in force. Raises ValueError, which names the fault."""
        try:
            with self._path.open("rb") as file:
                # Before the read: after a change during the read, the next check reads again.
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
            # Each check tries a file that can't be opened again, but reports the fault once.
            if text not in (problem.text for problem in self._problems.all()):
                log.error("%s: %s", OPTION, text)
                self._problems.solved(OPTION)
                self._problems.add(OPTION, text, holds=True)
        else:
            log.info("%s %s was read again", OPTION, self._path)
            self._problems.solved(OPTION)


def _signature(stat: os.stat_result) -> tuple[int, ...]:
    """A value that differs after a change of the file, or if another file has the name."""
    return stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns
