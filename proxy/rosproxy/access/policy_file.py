"""The file of ``--policy-file``: a rule on each line. The proxy reads the file when it changes.

If the file can't be read or has a mistake, the rules that were read before stay in force, and the
status has a problem until the file is correct.
"""

import logging
import os
from pathlib import Path

from rosproxy.access.access_policy import AccessPolicy
from rosproxy.shared.output.problems import Problems
from rosproxy.shared.policy.layers import PolicyLayer, PolicyMode
from rosproxy.shared.policy.rules import parse_rules

log = logging.getLogger(__name__)

CHECK_INTERVAL_S = 1.0
"""Time between two checks whether the file has changed, in seconds."""
LONGEST_FILE_BYTES = 1024 * 1024
"""Largest file that the proxy reads, in bytes."""
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
        self._refused_version: int | None = None
        """The version of the policy whose check refused the file; None if no check refused it."""

    def read(self) -> None:
        """Put the rules of the file in force.

        Raises ValueError, which names the fault: of the file, of a rule, or of a check of the
        policy.
        """
        self._refused_version = None
        try:
            with self._path.open("rb") as file:
                # Before the read: if the file changes during the read, the next check reads again.
                self._last_signature = file_signature(os.fstat(file.fileno()))
                text = file.read(LONGEST_FILE_BYTES + 1)
            if len(text) > LONGEST_FILE_BYTES:
                raise ValueError(f"{self._path} is longer than {LONGEST_FILE_BYTES} bytes")
            rules = parse_rules(text.decode())
        except OSError as error:
            self._last_signature = None
            raise ValueError(f"{self._path} can't be read: {error.strerror}") from None
        except UnicodeDecodeError:
            raise ValueError(f"{self._path} is not UTF-8 text") from None
        self._refused_version = self._policy.version
        self._policy.use_file(PolicyLayer(f"{OPTION} {self._path}", rules, self._mode))
        self._refused_version = None

    async def look(self) -> None:
        """Read the file again if it has changed; report a fault as a problem.

        Also read the file again after a read error. If a check refused the file, also read the file
        again after a change of the other layers, because the check depends on all layers.
        """
        try:
            if (
                file_signature(self._path.stat()) == self._last_signature
                and not self._is_refusal_old
            ):
                return
        except OSError:
            self._last_signature = None
        try:
            self.read()
        except ValueError as error:
            text = f"{error}. The rules that were read before stay in force"
            # While the file can't be opened, each check tries to read it. Report the fault once.
            if text not in (problem.text for problem in self._problems.all()):
                log.error("%s: %s", OPTION, text)
                self._problems.solved(OPTION)
                self._problems.add(OPTION, text, holds=True)
        else:
            log.info("%s %s was read again", OPTION, self._path)
            self._problems.solved(OPTION)

    @property
    def _is_refusal_old(self) -> bool:
        """Whether a check refused the file together with layers that have changed meanwhile."""
        return self._refused_version not in (None, self._policy.version)


def file_signature(stat: os.stat_result) -> tuple[int, ...]:
    """A value that differs after a change of the file or its permissions, or a replacement."""
    return stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns
