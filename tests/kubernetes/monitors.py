"""A configuration of Prometheus from the chart's monitors and alerts.

This replaces the Prometheus operator, and adds the same rules around a monitor's rules.
"""

import re
from pathlib import Path
from typing import Any

from tests.chart.chart import objects, of_kind
from tests.chart.monitoring import relabel_configs
from tests.docker.prometheus import hurried
from tests.kubernetes.api import Json

_VALUES = {name: {"enabled": True} for name in ("serviceMonitor", "podMonitor", "prometheusRule")}
_META = "__meta_kubernetes_"


def charts_configuration(directory: Path, discovery: str) -> Any:
    """The configuration that the chart's objects amount to, with shorter times.

    ``discovery`` is the URL at which Prometheus is told what there is in the cluster.
    """
    manifests = objects(_VALUES)
    (services,) = of_kind(manifests, "ServiceMonitor")
    (pods,) = of_kind(manifests, "PodMonitor")
    (alerts,) = of_kind(manifests, "PrometheusRule")
    jobs = [_service_job(services, discovery), _pod_job(pods, discovery)]
    hurry = hurried(directory, alerts["spec"])
    return {**hurry, "rule_files": ["alerts.yaml"], "scrape_configs": jobs}


def _service_job(monitor: Json, discovery: str) -> Json:
    (endpoint,) = monitor["spec"]["endpoints"]
    target = ["endpoint_address_target_kind", "endpoint_address_target_name"]
    rules = [
        *_selected("service", monitor),
        _rule(["endpoint_port_name"], action="keep", regex=endpoint["port"]),
        _rule(target, separator=";", regex="Node;(.*)", target_label="node"),
        _rule(target, separator=";", regex="Pod;(.*)", target_label="pod"),
        _rule(["namespace"], target_label="namespace"),
        _rule(["service_name"], target_label="service"),
        _rule(["pod_name"], target_label="pod"),
        _rule(["pod_container_name"], target_label="container"),
        _rule(["pod_phase"], action="drop", regex="(Failed|Succeeded)"),
        _rule(["service_name"], target_label="job"),
        {"target_label": "endpoint", "replacement": endpoint["port"]},
    ]
    return _job(monitor, endpoint, f"{discovery}/endpoints", rules)


def _pod_job(monitor: Json, discovery: str) -> Json:
    (endpoint,) = monitor["spec"]["podMetricsEndpoints"]
    metadata = monitor["metadata"]
    rules = [
        _rule(["pod_phase"], action="drop", regex="(Failed|Succeeded)"),
        *_selected("pod", monitor),
        _rule(["namespace"], target_label="namespace"),
        _rule(["pod_container_name"], target_label="container"),
        _rule(["pod_name"], target_label="pod"),
        {"target_label": "job", "replacement": f"{metadata['namespace']}/{metadata['name']}"},
    ]
    return _job(monitor, endpoint, f"{discovery}/pod", rules)


def _job(monitor: Json, endpoint: Json, url: str, rules: list[Json]) -> Json:
    metadata = monitor["metadata"]
    return {
        "job_name": f"{monitor['kind']}/{metadata['namespace']}/{metadata['name']}",
        "http_sd_configs": [
            {"url": f"{url}/{namespace}", "refresh_interval": "2s"}
            for namespace in _namespaces(monitor)
        ],
        "metrics_path": endpoint.get("path", "/metrics"),
        "relabel_configs": [*rules, *relabel_configs(endpoint)],
    }


def _namespaces(monitor: Json) -> list[str]:
    """The namespaces of a monitor. An empty name stands for all."""
    selector = monitor["spec"].get("namespaceSelector", {})
    if selector.get("any"):
        return [""]
    return list(selector.get("matchNames") or [monitor["metadata"]["namespace"]])


def _selected(kind: str, monitor: Json) -> list[Json]:
    """Keep the Services or pods that a monitor selects."""
    rules = []
    for name, value in monitor["spec"]["selector"]["matchLabels"].items():
        clean = re.sub(r"\W", "_", name)
        sources = [f"{kind}_label_{clean}", f"{kind}_labelpresent_{clean}"]
        rules.append(_rule(sources, action="keep", regex=f"({re.escape(value)});true"))
    return rules


def _rule(sources: list[str], **more: str) -> Json:
    return {"source_labels": [f"{_META}{source}" for source in sources], **more}
