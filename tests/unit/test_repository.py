"""Habits of the repository that no linter holds."""

import ast
import re
import subprocess
from pathlib import Path
from statistics import median

import click
import pytest
import yaml  # type: ignore[import-untyped]
from scripts import options_docs

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(
    path for root in ("proxy", "operator", "examples") for path in (ROOT / root).rglob("*.py")
)
REFERENCE = ROOT / "docs/reference"
MADE = {".venv", "build", "node_modules"}
PAGES = sorted(page for page in ROOT.rglob("*.md") if not MADE & set(page.relative_to(ROOT).parts))
MAX_FUNCTION_LINES = 45
MAX_MEDIAN_LINES = 10


def lines(node: ast.stmt) -> int:
    assert node.end_lineno is not None
    return node.end_lineno - node.lineno + 1


def functions(path: Path) -> dict[str, int]:
    """The lines of code of each function in a module, without docstrings and decorators."""
    sizes = {}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            docstring = lines(node.body[0]) if ast.get_docstring(node) else 0
            sizes[f"{path.relative_to(ROOT)}:{node.lineno} {node.name}"] = lines(node) - docstring
    return sizes


def run_options() -> list[click.Option]:
    from rosproxy.cli.main import main

    command = main.commands["run"]
    return [option for option in command.params if isinstance(option, click.Option)]


def test_functions_are_short() -> None:
    lengths = {name: length for path in SOURCES for name, length in functions(path).items()}
    assert not {name: length for name, length in lengths.items() if length > MAX_FUNCTION_LINES}
    assert median(lengths.values()) <= MAX_MEDIAN_LINES


def test_no_package_hides_the_standard_library() -> None:
    """`operator` is a source root. As a package it would hide Python's module."""
    assert not (ROOT / "operator/__init__.py").exists()


@pytest.mark.parametrize("command", ["make demo", "make test", "make test-all", "make check"])
def test_readme_names_the_commands(command: str) -> None:
    assert command in (ROOT / "README.md").read_text()


def test_the_yaml_of_the_pages_can_be_read() -> None:
    """A manifest that a reader pastes is YAML: in a fence, or in the input of kubectl."""
    fence = re.compile(r"^```yaml\n(.*?)^```|<<END\n(.*?)^END$", re.MULTILINE | re.DOTALL)
    found = {page: fence.findall(page.read_text()) for page in PAGES}
    assert any(found.values())
    for page, blocks in found.items():
        for block in blocks:
            try:
                list(yaml.safe_load_all("".join(block)))
            except yaml.YAMLError as error:
                pytest.fail(f"{page}: {error}")


def test_every_option_is_documented() -> None:
    text = (REFERENCE / "options.md").read_text()
    names = [name for option in run_options() for name in option.opts]
    variables = [str(option.envvar) for option in run_options() if option.envvar]
    missing = [name for name in names + variables if not re.search(rf"(?<![\w-]){name}\b", text)]
    assert not missing


def test_the_table_of_settings_is_that_of_the_code() -> None:
    page = options_docs.PAGE.read_text()
    assert page == options_docs.with_new_tables(page), "run: make manifests"


def test_architecture_names_what_exists() -> None:
    """The page names modules and tests, which must exist."""
    text = (ROOT / "docs/architecture.md").read_text()
    named = set(re.findall(r"`([\w./]+(?:\.py|/))`", text))
    roots = [ROOT, ROOT / "proxy/rosproxy", ROOT / "operator/rosproxy_operator"]
    roots += [roots[2] / "docker/planner", roots[2] / "kubernetes", roots[2] / "docker"]
    roots += [roots[2] / "kubernetes" / room for room in ("planner", "resources", "status")]
    assert len(named) > 60
    assert not {path for path in named if not any((root / path).exists() for root in roots)}


def test_every_promise_of_security_names_a_test_that_exists() -> None:
    named = set(
        re.findall(r"`((?:[a-z0-9_]+/)+test_[a-z0-9_]+\.py)`", (ROOT / "SECURITY.md").read_text())
    )
    assert len(named) > 20
    assert not {path for path in named if not (ROOT / "tests" / path).exists()}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_block_of_code_says_its_language(page: Path) -> None:
    fences = re.findall(r"^ *```(.*)$", page.read_text(), re.M)
    assert [language == "" for language in fences] == [False, True] * (len(fences) // 2)
    prose = re.sub(r"^ *```.*?^ *```$", "", page.read_text(), flags=re.M | re.S)
    assert not re.findall(r"\n\n    .*", prose)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    broken = []
    for target, anchor in re.findall(r"\]\((?!\w+:)([^)#\s]*)#?([^)\s]*)\)", page.read_text()):
        linked_page = page.parent / target if target else page
        if not linked_page.exists() or (anchor and anchor not in headings(linked_page)):
            broken.append(f"{target}#{anchor}")
    assert not broken


def headings(page: Path) -> set[str]:
    """The anchors of a page on GitHub and GitLab, with the former anchors of renamed headings."""
    text = page.read_text()
    titles = re.findall(r"^#+ (.*)$", text, re.M)
    anchors = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}
    return anchors | set(re.findall(r'^<a id="([\w-]+)"></a>$', text, re.M))


def test_scripts_can_be_run() -> None:
    scripts = [*(ROOT / "scripts").glob("*.sh"), ROOT / ".ci/run"]
    assert not [path.name for path in scripts if not path.stat().st_mode & 0o111]


def test_images_are_tagged_with_the_version() -> None:
    """The chart pulls the tag of its appVersion, which is the same version (tests/chart)."""
    from rosproxy import __version__

    make = ["make", "--dry-run", "image", "push", "REGISTRY=registry.example/ros"]
    said = subprocess.run(make, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in ("rosproxy", "rosproxy-operator"):
        image = f"registry.example/ros/{name}:{__version__}"
        assert f"--tag {image} " in said
        assert f"docker push {image}\n" in said


def reference() -> str:
    return "\n".join(page.read_text() for page in sorted(REFERENCE.glob("*.md")))


def test_reference_names_every_option_label_and_metric_of_docker() -> None:
    from rosproxy_operator.cli import main
    from rosproxy_operator.common.operator_metrics import DockerMetrics
    from rosproxy_operator.docker.planner.labels.readers import LABELS

    options = [opt for option in main.commands["docker"].params for opt in option.opts]
    metrics = [family.name for family in DockerMetrics().registry.collect()]
    own = [name for name in metrics if not name.startswith("process_")]
    text = reference()
    assert not [name for name in [*options, *LABELS, *own] if name not in text]


def test_reference_names_every_option_label_and_metric_of_kubernetes() -> None:
    from rosproxy_operator.cli import main
    from rosproxy_operator.common.operator_metrics import ClusterMetrics
    from rosproxy_operator.kubernetes.resources import names

    options = [opt for option in main.commands["kubernetes"].params for opt in option.opts]
    labels = [names.INJECT, names.PROXY_OF, names.NODE, names.PORT_RANGE, names.FINGERPRINT]
    annotations = [names.ADVERTISE_HOST, names.MASTER_URI, names.STATIC_PEERS]
    metrics = [family.name for family in ClusterMetrics().registry.collect()]
    own = [name for name in metrics if not name.startswith("process_")]
    text = reference()
    assert not [name for name in [*options, *labels, *annotations, *own] if name not in text]


def test_reference_names_every_metric_of_the_proxy() -> None:
    from rosproxy.telemetry.metrics import Metrics

    metrics = [family.name for family in Metrics().registry.collect()]
    own = [name for name in metrics if not name.startswith("process_")]
    text = reference()
    assert not [name for name in own if name not in text]


def rules() -> dict[str, set[str]]:
    """The required verbs of the controller's service account by resource, from the docstring."""
    from rosproxy_operator.kubernetes.api import api_client

    lines = re.findall(r"^    ([a-z/]+) {2,}([a-z ]+)$", api_client.__doc__ or "", re.M)
    return {resource: set(verbs.split()) for resource, verbs in lines}


def test_the_chart_gives_users_no_right_to_a_status() -> None:
    """The operator recreates a lost Service at the address in the RosProxy's status."""
    text = (ROOT / "charts/rosproxy-operator/templates/rbac.yaml").read_text()
    for_users = text.partition(".Values.rbac.aggregate")[2]
    assert re.findall(r"resources: (.+)", for_users) == ["[rosproxies]", "[rosproxies]"]


def test_the_chart_grants_what_the_code_calls_and_no_more() -> None:
    granted: dict[str, set[str]] = {}
    text = (ROOT / "charts/rosproxy-operator/templates/rbac.yaml").read_text()
    text = text.partition(".Values.rbac.aggregate")[0]  # what follows is for users
    text += (ROOT / "charts/rosproxy-operator/templates/_rules.tpl").read_text()
    for resources, verbs in re.findall(
        r"resources: \[([^\]]+)\](?:\n *resourceNames:.*)?\n *verbs: \[([^\]]+)\]", text
    ):
        for resource in resources.split(","):
            granted.setdefault(resource.strip(), set()).update(map(str.strip, verbs.split(",")))
    assert rules()
    assert {resource: granted.get(resource) for resource in rules()} == rules()


def test_reference_names_every_rule() -> None:
    text = (REFERENCE / "permissions.md").read_text()
    assert not [resource for resource in rules() if resource not in text]
