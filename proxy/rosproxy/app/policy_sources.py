"""The sources of the policy in a running proxy: options, policy file, operator.

The rules of the options stay. The rules of the file and of the operator may change at any time.
After a change of the file, each stack (ROS 1, ROS 2, rmw_zenoh) notices the new version of the
policy by itself. When an operator posts rules, the stacks apply the rules before the proxy answers.
"""

import logging
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

from rosproxy.access.access_policy import AccessPolicy
from rosproxy.access.policy_file import CHECK_INTERVAL_S, OPTION, PolicyFile
from rosproxy.app.stacks import Stack
from rosproxy.runtime import Runtime
from rosproxy.shared.documents.requests import BodyError, PolicyUpdate, read_body
from rosproxy.shared.documents.status_document import to_json
from rosproxy.shared.output.problems import Problems
from rosproxy.shared.policy.layers import PolicyMode, read_layer
from rosproxy.shared.setting_kinds import SettingError
from rosproxy.shared.settings import Settings
from rosproxy.shared.zenoh_rules.name_sets import check_layers
from rosproxy.telemetry.metrics import Metrics
from rosproxy.telemetry.refusals import Refusals

log = logging.getLogger(__name__)

OPERATOR_POLICY = "the operator's policy"
"""The subject of a problem: the proxy has refused a policy of the operator."""


class PolicySources:
    """Puts the rules of the policy file and of the operator in force."""

    def __init__(self, runtime: Runtime, stacks: Sequence[Stack]) -> None:
        self._runtime = runtime
        self._stacks = stacks

    def start(self) -> None:
        """Read the policy file, if one is set, and check the file for changes from now on.

        Raises SettingError for a file that can't be read or has a mistake.
        """
        runtime = self._runtime
        settings = self._runtime.settings
        if not settings.policy_file:
            return
        file = PolicyFile(
            settings.policy_file, PolicyMode(settings.policy_mode), runtime.policy, runtime.problems
        )
        _read(file)
        runtime.tasks.repeat(file.look, CHECK_INTERVAL_S, "checking the policy file")

    async def post(self, body: Any) -> dict[str, Any]:
        """``POST /policy``: put the layers in force, and return the EnforcementCounts as JSON.

        Raises BodyError, CallFailed.
        """
        problems = self._runtime.problems
        try:
            self._use_operator_layers(body)
        except BodyError as error:
            # `Problems.add` does not replace a problem with another text. So the earlier refusal
            # has to go first.
            problems.solved(OPERATOR_POLICY)
            text = f"refused: {error}. The previous policy stays in force"
            problems.add(OPERATOR_POLICY, text, holds=True)
            log.warning("%s refused: %s", OPERATOR_POLICY, error)
            raise
        problems.solved(OPERATOR_POLICY)
        counts = Counter[str]()
        for stack in reversed(self._stacks):  # ROS 1 last: may fail while the master is away
            counts.update(to_json(await stack.apply_policy()))
        return dict(counts)

    def _use_operator_layers(self, body: Any) -> None:
        """Put the layers of a body in force. Raises BodyError."""
        written = read_body(body, PolicyUpdate).layers
        try:
            self._runtime.policy.use_operator_layers([read_layer(layer) for layer in written])
        except ValueError as error:
            raise BodyError(f"layers: {error}") from None


def check_policy_file(settings: Settings) -> None:
    """Check the policy file of the settings, if one is set. Raises SettingError.

    The limits on the number of layers and rules count file and options together, as in a running
    proxy.
    """
    if settings.policy_file:
        metrics = Metrics()
        problems = Problems()
        refusals = Refusals(metrics, problems, time.monotonic)
        policy = AccessPolicy(settings.policy, settings.policy_layers, metrics, refusals)
        if settings.for_zenoh:
            policy.checks.append(check_layers)
        _read(PolicyFile(settings.policy_file, PolicyMode(settings.policy_mode), policy, problems))


def _read(file: PolicyFile) -> None:
    try:
        file.read()
    except ValueError as error:
        raise SettingError(OPTION, str(error)) from None
