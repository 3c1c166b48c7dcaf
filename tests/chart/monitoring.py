"""The queries of the dashboard and of the alerts, for tests."""

import json
import re
from collections.abc import Iterator
from typing import Any

import yaml  # type: ignore[import-untyped]

from rosproxy_operator.common.operator_metrics import ClusterMetrics, CommonMetrics, DockerMetrics
from tests.chart.chart import CHART, ROOT, Json

ALERTS = CHART / "files/alerts.yaml"
DASHBOARD = CHART / "files/dashboard.json"
GUIDE = ROOT / "docs/guide/monitoring.md"
RUNBOOK = ROOT / "docs/guide/alerts.md"


def alerts() -> list[Json]:
    """All alerts."""
    (group,) = yaml.safe_load(ALERTS.read_text())["groups"]
    rules: list[Json] = group["rules"]
    return rules


def panels() -> list[Json]:
    """The panels that show something, without the rows' titles."""
    return [
        panel for panel in json.loads(DASHBOARD.read_text())["panels"] if panel["type"] != "row"
    ]


def expressions() -> Iterator[tuple[str, str]]:
    """Each panel's title with each of its queries, for all proxies and over half a minute.

    Without the zero for missing data, with which each query would have data.
    """
    for panel in panels():
        for target in panel["targets"]:
            query = target["expr"].replace("$instance", ".*").replace("$__rate_interval", "30s")
            yield panel["title"], query.removesuffix(" or vector(0)")


def metrics(query: str) -> set[str]:
    """The metrics of the project and of its processes that a query names."""
    return set(re.findall(r"\b(?:rosproxy|process)_\w+", query))


def of_kubernetes(query: str) -> bool:
    """Whether a query is for what the operator on Kubernetes alone counts."""
    return bool(metrics(query) & (_families(ClusterMetrics()) - _families(DockerMetrics())))


def of_docker(query: str) -> bool:
    """Whether a query is for what the operator on Docker alone counts."""
    return bool(metrics(query) & (_families(DockerMetrics()) - _families(ClusterMetrics())))


def _families(metrics: CommonMetrics) -> set[str]:
    """The names of the metrics in queries."""
    described = metrics.registry.collect()
    return {
        f"{family.name}_total" if family.type == "counter" else family.name for family in described
    }


def relabel_configs(endpoint: Json) -> list[Json]:
    """The relabelings of a monitor's endpoint, with the names of Prometheus' own file.

    The Prometheus operator passes relabelings on unchanged.
    """
    names = {"sourceLabels": "source_labels", "targetLabel": "target_label"}
    return [
        {names.get(key, key): value for key, value in rule.items()}
        for rule in endpoint["relabelings"]
    ]


def scrape_configs() -> list[Any]:
    """The configurations of Prometheus in the guide."""
    return [block for block in _guide_blocks() if isinstance(block, dict)]


def further_relabelings() -> list[Any]:
    """The rules of the guide to add to the ``relabel_configs`` of the proxies on Docker."""
    return [rule for block in _guide_blocks() if isinstance(block, list) for rule in block]


def _guide_blocks() -> list[Any]:
    blocks = re.findall(r"^```yaml\n(.*?)^```$", GUIDE.read_text(), re.M | re.S)
    return [yaml.safe_load(block) for block in blocks]
