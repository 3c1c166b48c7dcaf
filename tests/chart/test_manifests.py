"""Generated files are up to date with the chart."""

import itertools
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml  # type: ignore[import-untyped]
from scripts import custom_resource_docs

from rosproxy import __version__
from rosproxy_operator.cli import main
from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.settings import make_kubernetes_settings
from tests.chart.chart import CHART, ROOT, Json, objects, of_kind, parse, program

README = CHART / "README.md"
INSTALL = ROOT / "manifests/install.yaml"
EXAMPLE = ROOT / "manifests/example.yaml"


def test_install_is_the_chart(tmp_path: Path) -> None:
    subprocess.run([ROOT / "scripts/manifests.sh", tmp_path], check=True, timeout=60)
    made = (tmp_path / "install.yaml").read_text()
    assert INSTALL.read_text() == made, "run: make manifests"
    assert README.read_text() == (tmp_path / "README.md").read_text(), "run: make manifests"


def test_tables_are_the_definition() -> None:
    page = custom_resource_docs.PAGE.read_text()
    assert page == custom_resource_docs.with_new_tables(page), "run: make manifests"


def test_install_has_no_trace_of_helm() -> None:
    for manifest in parse(INSTALL.read_text()):
        assert not [key for key in manifest["metadata"].get("annotations", {}) if "helm" in key]
        assert manifest["metadata"].get("labels", {}).get("app.kubernetes.io/managed-by") != "Helm"
        assert not manifest["metadata"]["name"].endswith("-test")


def kustomize(directory: Path) -> list[Json]:
    words = [str(program().with_name("kubectl")), "kustomize", str(directory)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return parse(done.stdout)


def test_kustomize_has_the_same_objects() -> None:
    def sorted_by_id(manifests: list[Json]) -> list[Json]:
        return sorted(
            manifests, key=lambda manifest: (manifest["kind"], manifest["metadata"]["name"])
        )

    assert sorted_by_id(kustomize(INSTALL.parent)) == sorted_by_id(parse(INSTALL.read_text()))


def test_the_guides_overlay_names_both_images(tmp_path: Path) -> None:
    guide = (ROOT / "docs/guide/kubernetes.md").read_text()
    (text,) = re.findall(r"^```yaml\n(resources: .*?)^```$", guide, re.M | re.S)
    assert __version__ in text
    shutil.copytree(INSTALL.parent, tmp_path / "manifests")
    (tmp_path / "overlay").mkdir()
    (tmp_path / "overlay/kustomization.yaml").write_text(text)
    (deployment,) = of_kind(kustomize(tmp_path / "overlay"), "Deployment")
    (container,) = deployment["spec"]["template"]["spec"]["containers"]
    assert container["image"] == f"registry.example/ros/rosproxy-operator:{__version__}"
    command, *words = container["args"]
    context = main.commands[command].make_context(command, words)
    settings = make_kubernetes_settings(context.params)
    assert settings.plan.image == f"registry.example/ros/rosproxy:{__version__}"


def test_install_makes_its_namespace_first() -> None:
    first, *rest = parse(INSTALL.read_text())
    assert first["kind"] == "Namespace"
    namespaces = {manifest["metadata"].get("namespace") for manifest in rest}
    assert namespaces == {None, first["metadata"]["name"]}


def test_version_is_the_projects() -> None:
    about = (CHART / "Chart.yaml").read_text()
    assert f"\nversion: {__version__}\n" in about
    assert f"\nappVersion: {__version__}\n" in about


def test_every_value_has_a_comment() -> None:
    """helm-docs leaves the meaning empty where values.yaml has no comment that begins with --."""
    rows = re.findall(r"^\| `([\w.]+)` \| (.*) \| (.*) \|$", README.read_text(), re.M)
    values = yaml.safe_load((CHART / "values.yaml").read_text())
    assert {path for path, _, _ in rows} >= set(leaves(values))
    assert [path for path, _, meaning in rows if not meaning] == []


def test_comparison_names_values_of_the_chart() -> None:
    table = README.read_text().partition("\n| capability |")[2]
    cells = [row.strip(" |").rpartition("|")[2] for row in table.splitlines()[2:]]
    named = set(re.findall(r"`([a-z][\w.]+)`", " ".join(cells))) - {"null", "valueFrom", "signKey"}
    values = yaml.safe_load((CHART / "values.yaml").read_text())
    paths = [path.split(".") for path in leaves(values)]
    known = {".".join(path[:length]) for path in paths for length in range(1, len(path) + 1)}
    assert len(named) > 30
    assert named <= known


def leaves(values: Json, path: str = "") -> Iterator[str]:
    for name, value in values.items():
        if isinstance(value, dict) and value:
            yield from leaves(value, f"{path}{name}.")
        else:
            yield f"{path}{name}"


def test_example_labels_its_pods() -> None:
    example = parse(EXAMPLE.read_text())
    labelled = [deployment["metadata"]["name"] for deployment in of_kind(example, "Deployment")
                if names.INJECT
                in deployment["spec"]["template"]["metadata"]["labels"]]  # fmt: skip
    assert labelled == ["talker", "listener"]
    assert {manifest["metadata"].get("namespace", "ros-example") for manifest in example} == {
        "ros-example"
    }
    (rosproxy,) = of_kind(example, "RosProxy")
    services = [service["metadata"]["name"] for service in of_kind(example, "Service")]
    assert rosproxy["spec"]["master"]["service"]["name"] in services


@pytest.mark.parametrize("values", [{}, {"namespaces": ["a"]}])
def test_page_lists_the_rights(values: Json) -> None:
    """docs/reference/permissions.md has exactly the rules of the roles."""
    manifests = objects(values)
    roles = [*of_kind(manifests, "ClusterRole"), *of_kind(manifests, "Role")]
    granted = {
        (group, resource, tuple(sorted(rule["verbs"])))
        for role in roles
        for rule in role["rules"]
        for group in rule["apiGroups"]
        for resource in rule["resources"]
    }
    assert granted == documented_rights()


def documented_rights() -> set[tuple[str, str, tuple[str, ...]]]:
    page = ROOT / "docs/reference/permissions.md"
    section = page.read_text().partition("| group | resources |")[2]
    rows = section.partition("\n\n")[0].splitlines()[2:]
    cells = [[cell.strip(" `") for cell in row.strip("|").split("|")] for row in rows]
    return {(row[0], row[1], tuple(sorted(row[2].split(", ")))) for row in cells}


def test_named_secrets_only() -> None:
    """Rights on critical objects are for single names only."""
    rules = [rule for role in [*of_kind(objects(), "ClusterRole"), *of_kind(objects(), "Role")]
             for rule in role["rules"]]  # fmt: skip
    for rule in rules:
        assert "*" not in str(rule)
        named = {"secrets", "mutatingwebhookconfigurations", "leases"} & set(rule["resources"])
        if rule["resources"] == ["leases"] and rule["verbs"] == ["create"]:
            continue  # what is yet to be made can't be granted by name
        assert bool(rule.get("resourceNames")) == bool(named)


def test_writes_in_named_namespaces_only() -> None:
    manifests = objects({"namespaces": ["a", "b"]})
    verbs = {verb for role in of_kind(manifests, "ClusterRole") for rule in role["rules"]
             if "resourceNames" not in rule for verb in rule["verbs"]}  # fmt: skip
    assert verbs == {"get", "list", "watch"}
    writing = {role["metadata"]["namespace"] for role in of_kind(manifests, "Role")
               if any("create" in rule["verbs"] and rule["resources"] != ["leases"]
                      for rule in role["rules"])}  # fmt: skip
    assert writing == {"a", "b"}


def test_every_rule_has_a_comment() -> None:
    templates = [CHART / "templates/rbac.yaml", CHART / "templates/_rules.tpl"]
    rules = 0
    for path in templates:
        lines = path.read_text().splitlines()
        for before, line in itertools.pairwise(lines):
            if line.strip().startswith("- apiGroups:"):
                rules += 1
                # The comment for users' edit is also for users' view.
                assert before.strip().startswith("#") or "rules:" in before, (path.name, line)
    assert rules == 17
