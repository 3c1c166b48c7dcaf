"""All parts of a release have the same version, and the workflow uses the tested versions."""

import re
import shutil
from pathlib import Path

import pytest
import yaml  # type: ignore[import-untyped]
from scripts.release_check import (
    CHART,
    Release,
    ReleaseFault,
    adapt,
    chart_changes,
    check_versions,
    newest,
    project_version,
)

ROOT = Path(__file__).resolve().parents[2]
WORKFLOWS = ROOT / ".github/workflows"
RELEASE = (WORKFLOWS / "release.yaml").read_text()


def release(version: str = "", tag: str = "") -> Release:
    return Release(version or project_version(), tag, "", "", "")


def test_one_version_everywhere() -> None:
    check_versions(release())


def test_another_version_is_named_with_its_place() -> None:
    with pytest.raises(ReleaseFault, match=r"Chart\.yaml, appVersion"):
        check_versions(release("9.9.9"))


def test_a_release_has_its_entry_in_the_changelog(tmp_path: Path) -> None:
    changelog = tmp_path / "CHANGELOG.md"
    changelog.write_text("# Changelog\n\n## [Unreleased]\n\n## [1.2.3] - 2030-01-31\n\n- x\n")
    assert newest(changelog) == "1.2.3"
    changelog.write_text("# Changelog\n\n## [Unreleased]\n\n- new\n\n## [1.2.3] - 2030-01-31\n")
    with pytest.raises(ReleaseFault, match="Unreleased"):
        newest(changelog)


def test_the_published_chart_is_described(tmp_path: Path) -> None:
    shutil.copytree(CHART, tmp_path, dirs_exist_ok=True)
    version = project_version()
    adapt(tmp_path, Release(version, "", "", "ghcr.io/me", "https://github.com/me/rosproxy"))
    about = yaml.safe_load((tmp_path / "Chart.yaml").read_text())
    assert about["home"] == "https://github.com/me/rosproxy"
    icon = f"https://github.com/me/rosproxy/raw/v{version}/"
    assert about["icon"].startswith(icon)
    assert (ROOT / about["icon"].removeprefix(icon)).exists()
    annotations = about["annotations"]
    assert yaml.safe_load(annotations["artifacthub.io/images"]) == [
        {"name": "rosproxy", "image": f"ghcr.io/me/rosproxy:{version}"},
        {"name": "rosproxy-operator", "image": f"ghcr.io/me/rosproxy-operator:{version}"},
    ]
    assert yaml.safe_load(annotations["artifacthub.io/changes"])
    assert annotations["artifacthub.io/license"] == "Apache-2.0"
    assert (tmp_path / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
    assert "repository: ghcr.io/me/rosproxy-operator\n" in (tmp_path / "values.yaml").read_text()
    alerts = (tmp_path / "files/alerts.yaml").read_text()
    runbook = f"https://github.com/me/rosproxy/blob/v{version}/docs/guide/alerts.md"
    assert alerts.count("runbook_url: ") == alerts.count(f"runbook_url: {runbook}#") > 0


def test_changes_of_the_chart_are_those_of_kubernetes() -> None:
    changelog = (
        "# Changelog\n\n## [1.2.3] - 2030-01-31\n\n### Docker\n\n- x\n\n### Kubernetes\n\n"
        "- One `a`\n  ([guide](docs/guide/kubernetes.md)).\n- Two.\n\n### To try\n\n- y\n\n"
        "## [1.2.2] - 2029-01-31\n\n### Kubernetes\n\n- z\n"
    )
    assert chart_changes(changelog, "1.2.3") == ["One `a` (guide).", "Two."]


def test_workflows_have_the_tests_helm() -> None:
    module = (ROOT / "tests/kubernetes/tools/helm/go.mod").read_text()
    (version,) = re.findall(r"^\thelm\.sh/helm/v3 (v\S+)", module, re.M)
    text = RELEASE + (WORKFLOWS / "check.yaml").read_text()
    assert set(re.findall(r"setup-helm@.*\n +with:\n +version: (\S+)", text)) == {version}


def test_actions_that_sign_and_publish_are_pinned() -> None:
    """A moved tag could run other code with the right to publish."""
    uses = set(re.findall(r"uses: ([\w./-]+)@(\S+)", RELEASE))
    own = {name for name, _ in uses if name.startswith("actions/") and "attest" not in name}
    others = {at for name, at in uses if name not in own}
    assert len(others) > 5
    # PyPI's action recommends this branch, and runs an image of the same name.
    assert {at for at in others if not re.fullmatch("[0-9a-f]{40}", at)} == {"release/v1"}


def test_nothing_that_others_choose_becomes_a_command() -> None:
    """Expressions are put into scripts as text: what a tag or a branch is called would be run."""
    for script in re.findall(r"^ +(?:- )?run: (.*(?:\n {10,}.*)*)", RELEASE, re.M):
        assert "${{" not in script.partition("\n        env:")[0], script
