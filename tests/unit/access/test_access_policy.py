"""The policy in force: sources of layers, and the policy in the status."""

import errno
import io
from pathlib import Path

import pytest

from rosproxy.access.access_policy import AccessPolicy
from rosproxy.access.policy_file import PolicyFile
from rosproxy.shared.output.problems import Problems
from rosproxy.shared.policy.layers import PolicyLayer, PolicyMode
from rosproxy.shared.policy.rules import RuleKind, parse_rules
from rosproxy.telemetry.metrics import Metrics
from rosproxy.telemetry.refusals import Refusals

PUBLISH = RuleKind.PUBLISH


def layer(rules: str, mode: PolicyMode = PolicyMode.ENFORCE) -> PolicyLayer:
    return PolicyLayer("web", parse_rules(rules), mode)


@pytest.fixture
def problems() -> Problems:
    return Problems()


@pytest.fixture
def metrics() -> Metrics:
    return Metrics()


@pytest.fixture
def policy(problems: Problems, metrics: Metrics) -> AccessPolicy:
    refusals = Refusals(metrics, problems, lambda: 0.0)
    return AccessPolicy([layer("deny publish /own")], [], metrics, refusals)


def denies(policy: AccessPolicy, name: str) -> bool:
    return not policy.judge(PUBLISH, name, ["/n"], "10.0.0.1").allowed


def test_told_layers_replace_each_other_and_keep_the_own(policy: AccessPolicy) -> None:
    policy.use_operator_layers([layer("deny publish /first")])
    assert denies(policy, "/first")
    version = policy.version
    policy.use_operator_layers([layer("deny publish /second")])
    assert policy.version != version
    assert [denies(policy, name) for name in ("/own", "/first", "/second")] == [True, False, True]


def test_too_many_rules_change_nothing(policy: AccessPolicy) -> None:
    with pytest.raises(ValueError, match="1001 rules"):
        policy.use_operator_layers([layer("deny publish /first;" * 1000)])
    assert not denies(policy, "/first")


def test_denials_are_told_with_rule_and_layer(
    policy: AccessPolicy, problems: Problems, metrics: Metrics
) -> None:
    policy.use_operator_layers([layer("deny publish /audited", PolicyMode.AUDIT)])
    assert not policy.ask(PUBLISH, "/own", ["/n"], "10.0.0.1").allowed
    assert policy.ask(PUBLISH, "/audited", ["/n"], "10.0.0.1", source="10.0.0.9").allowed
    assert policy.ask(PUBLISH, "/else", ["/n"], "10.0.0.1").allowed
    assert [(p.subject, p.text) for p in problems.all()] == [
        (
            "refused: policy",
            "from 10.0.0.1: publish /own of /n is denied by policy of web: deny publish /own",
        ),
        (
            "refused: policy audit",
            "from 10.0.0.9: publish /audited of /n would be denied by policy of web: deny publish "
            "/audited",
        ),
    ]
    for mode in ("enforce", "audit"):
        labels = {"kind": "publish", "mode": mode}
        assert metrics.registry.get_sample_value("rosproxy_policy_denied_total", labels) == 1


def test_one_of_several_names_that_is_denied_denies_all(policy: AccessPolicy) -> None:
    policy.use_operator_layers([layer("deny publish /x by /b")])
    assert policy.judge(PUBLISH, "/x", ["/a"], "").allowed
    assert not policy.judge(PUBLISH, "/x", ["/a", "/b"], "").allowed


@pytest.mark.parametrize("content", [b"deny it", b"\xff", b"#" * 1024 * 1024 + b"\n", None])
async def test_a_bad_file_leaves_the_rules_in_force(
    policy: AccessPolicy, problems: Problems, tmp_path: Path, content: bytes | None
) -> None:
    path = tmp_path / "rules"
    path.write_text("deny publish /filed")
    file = PolicyFile(str(path), PolicyMode.ENFORCE, policy, problems)
    file.read()
    if content is None:
        path.unlink()
    else:
        path.write_bytes(content)
    for _ in range(2):
        await file.look()
        assert [problem.subject for problem in problems.all()] == ["--policy-file"]
    assert denies(policy, "/filed")
    path.write_text("deny publish /mended")
    await file.look()
    assert problems.all() == []
    assert denies(policy, "/mended")
    assert not denies(policy, "/filed")


async def test_a_file_that_operator_layers_left_no_room_for_is_read_again_once_they_change(
    policy: AccessPolicy, problems: Problems, tmp_path: Path
) -> None:
    path = tmp_path / "rules"
    path.write_text("deny publish /filed")
    file = PolicyFile(str(path), PolicyMode.ENFORCE, policy, problems)
    policy.use_operator_layers([layer("deny publish /first;" * 999)])
    for _ in range(2):
        await file.look()
        assert [problem.subject for problem in problems.all()] == ["--policy-file"]
    policy.use_operator_layers([layer("deny publish /first")])
    await file.look()
    assert problems.all() == []
    assert denies(policy, "/filed")


class UnreadableFile(io.FileIO):
    """A file on a device that fails."""

    def read(self, _: int | None = -1) -> bytes:
        raise OSError(errno.EIO, "Input/output error")


async def test_a_file_whose_read_failed_is_read_again(
    policy: AccessPolicy, problems: Problems, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "rules"
    path.write_text("deny publish /filed")
    file = PolicyFile(str(path), PolicyMode.ENFORCE, policy, problems)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", UnreadableFile)
        await file.look()
    assert [problem.subject for problem in problems.all()] == ["--policy-file"]
    await file.look()
    assert problems.all() == []
    assert denies(policy, "/filed")
