"""Dashboard and alerts: the same source for all places, and all metrics exist."""

import itertools
import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml  # type: ignore[import-untyped]

from rosproxy_operator.kubernetes.resources.names import ADMIN_PORT, own_labels
from tests.chart.chart import OPTIONS, ROOT, Json, objects, of_kind
from tests.chart.monitoring import (
    ALERTS,
    DASHBOARD,
    RUNBOOK,
    alerts,
    expressions,
    further_relabelings,
    metrics,
    panels,
    relabel_configs,
    scrape_configs,
)
from tests.docker.engine import wait_until
from tests.docker.prometheus import running_prometheus

KINDS = {"ServiceMonitor", "PodMonitor", "PrometheusRule"}
ALL = {name: {"enabled": True}
       for name in ("serviceMonitor", "podMonitor", "prometheusRule", "dashboard")}  # fmt: skip


def dashboards(manifests: list[Json]) -> list[Json]:
    return [config_map for config_map in of_kind(manifests, "ConfigMap")
            if "grafana_dashboard" in config_map["metadata"]["labels"]]  # fmt: skip


def test_off_by_default() -> None:
    manifests = objects()
    assert not KINDS & {manifest["kind"] for manifest in manifests}
    assert not dashboards(manifests)


def test_the_chart_has_the_same_dashboard() -> None:
    (config,) = dashboards(objects(ALL))
    (text,) = config["data"].values()
    assert json.loads(text) == json.loads(DASHBOARD.read_text())


def test_the_chart_has_the_same_alerts() -> None:
    (rule,) = of_kind(objects(ALL), "PrometheusRule")
    assert rule["spec"] == yaml.safe_load(ALERTS.read_text())


def test_alerts_link_to_where_the_values_say() -> None:
    runbook = "https://docs.example/alerts/"
    manifests = objects({"prometheusRule": {"enabled": True, "runbook": runbook}})
    (rule,) = of_kind(manifests, "PrometheusRule")
    (group,) = rule["spec"]["groups"]
    links = [alert["annotations"]["runbook_url"] for alert in group["rules"]]
    assert links == [f"{runbook}#{alert['alert'].lower()}" for alert in alerts()]


def test_more_fields_of_the_monitors_keep_those_of_the_chart() -> None:
    plain = objects(ALL)
    more = objects(OPTIONS["extras"]["all"])
    for kind, endpoints in (
        ("ServiceMonitor", "endpoints"),
        ("PodMonitor", "podMetricsEndpoints"),
    ):
        (before,) = of_kind(plain, kind)
        (after,) = of_kind(more, kind)
        values = OPTIONS["extras"]["all"][f"{kind[0].lower()}{kind[1:]}"]
        added = {key: after["spec"][key] for key in after["spec"].keys() - before["spec"].keys()}
        assert added == values["spec"]
        (endpoint,) = after["spec"][endpoints]
        assert endpoint.items() >= values["endpoint"].items()
        for relabeling in before["spec"][endpoints][0]["relabelings"]:
            assert relabeling in endpoint["relabelings"]


def test_alerts_and_dashboard_may_be_in_the_namespace_of_prometheus() -> None:
    manifests = objects(OPTIONS["extras"]["all"])
    (rule,) = of_kind(manifests, "PrometheusRule")
    (dashboard,) = dashboards(manifests)
    for metadata in (rule["metadata"], dashboard["metadata"]):
        assert metadata["namespace"] == "monitoring"
    assert rule["metadata"]["annotations"] == {"a": "b"}


@pytest.mark.parametrize(
    ("namespaces", "selector"),
    [([], {"any": True}), (["robots", "arms"], {"matchNames": ["robots", "arms"]})],
)
def test_proxies_of_all_namespaces_are_scraped(namespaces: list[str], selector: Json) -> None:
    (monitor,) = of_kind(objects({**ALL, "namespaces": namespaces}), "PodMonitor")
    labels = own_labels("robot")
    assert monitor["spec"]["selector"]["matchLabels"].items() <= labels.items()
    assert monitor["spec"]["namespaceSelector"] == selector


@pytest.mark.parametrize("address", ["127.0.0.7", "::1"])
def test_a_proxys_targets_all_become_its_admin_endpoint(address: str, tmp_path: Path) -> None:
    """A pod declares only its hostPorts, and each gives a target. Prometheus itself
    relabels here.
    """
    (monitor,) = of_kind(objects(ALL), "PodMonitor")
    (endpoint,) = monitor["spec"]["podMetricsEndpoints"]
    assert not {"port", "portNumber", "targetPort"} & endpoint.keys()
    pod = {"__meta_kubernetes_pod_ip": address, "__meta_kubernetes_pod_name": "rosproxy-a"}
    host = f"[{address}]" if ":" in address else address
    (target,) = targets(tmp_path, pod, endpoint, f"{host}:11400", f"{host}:11401")
    assert target["scrapeUrl"] == f"http://{host}:{ADMIN_PORT}/metrics"
    assert target["labels"] == {"job": "rosproxy", "instance": "rosproxy-a"}


def test_the_operator_is_called_as_alerts_have_it(tmp_path: Path) -> None:
    (monitor,) = of_kind(objects(ALL), "ServiceMonitor")
    (endpoint,) = monitor["spec"]["endpoints"]
    pod = {"__meta_kubernetes_pod_name": "operator-a"}
    (target,) = targets(tmp_path, pod, endpoint, "127.0.0.7:11313")
    assert target["labels"] == {"job": "rosproxy-operator", "instance": "operator-a"}


def targets(directory: Path, labels: Json, endpoint: Json, *addresses: str) -> list[Json]:
    """Prometheus' targets for discovered addresses and labels, by a monitor's rules."""
    targets_file = directory / "found.json"
    targets_file.write_text(json.dumps([{"targets": addresses, "labels": labels}]))
    job = {"job_name": "found", "file_sd_configs": [{"files": [str(targets_file)]}],
           "relabel_configs": relabel_configs(endpoint), "scrape_interval": "1h",
           "scrape_timeout": "1s"}  # fmt: skip
    with running_prometheus(directory, {"scrape_configs": [job]}) as prometheus:
        wait_until(lambda: bool(prometheus.targets()), 30, "the file is read")
        return prometheus.targets()


@pytest.mark.parametrize("alert", alerts(), ids=lambda alert: str(alert["alert"]))
def test_alerts_say_what_it_is_and_what_to_do(alert: Json) -> None:
    said = alert["annotations"]
    assert "{{ $labels.instance }}" in said["summary"]
    assert re.search(r"`(rosproxy|docker|kubectl)", said["description"])
    assert alert["labels"]["severity"] in ("critical", "warning")
    page, _, anchor = said["runbook_url"].partition("#")
    assert ROOT / page == RUNBOOK
    assert anchor == alert["alert"].lower()
    assert f"\n## {alert['alert']}\n" in RUNBOOK.read_text()


def test_no_page_without_an_alert() -> None:
    titles = re.findall(r"^## (\w+)$", RUNBOOK.read_text(), re.M)
    assert titles == [alert["alert"] for alert in alerts()]


def test_panels_can_be_told_apart_and_do_not_overlap() -> None:
    all_panels = json.loads(DASHBOARD.read_text())["panels"]
    ids = [panel["id"] for panel in all_panels]
    assert len(set(ids)) == len(ids)
    taken: set[tuple[int, int]] = set()
    for panel in all_panels:
        at = panel["gridPos"]
        across = range(at["x"], at["x"] + at["w"])
        down = range(at["y"], at["y"] + at["h"])
        cells = set(itertools.product(across, down))
        assert across[-1] < 24
        assert not cells & taken, panel["title"]
        taken |= cells
    assert {target["datasource"]["uid"] for panel in panels() for target in panel["targets"]} == {
        "${datasource}"
    }


def test_what_is_asked_for_is_documented() -> None:
    page = (ROOT / "docs/reference/metrics.md").read_text()
    asked = {*(query for _, query in expressions()), *(alert["expr"] for alert in alerts())}
    names = {re.sub(r"_bucket$", "", name) for query in asked for name in metrics(query)}
    assert len(names) > 30
    assert not [name for name in names if f"`{name}" not in page and name[:8] != "process_"]


def promtool(*words: str | Path) -> str:
    done = subprocess.run(["promtool", *words], capture_output=True, text=True, check=False,
                          timeout=60)  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_prometheus_can_read_the_alerts() -> None:
    assert f"SUCCESS: {len(alerts())} rules found" in promtool("check", "rules", ALERTS)


def test_prometheus_can_read_the_guides_configurations(tmp_path: Path) -> None:
    (tmp_path / "alerts.yaml").write_text(ALERTS.read_text())
    for number, config in enumerate(scrape_configs()):
        path = tmp_path / f"{number}.yaml"
        path.write_text(yaml.safe_dump(config))
        assert "SUCCESS" in promtool("check", "config", path)
    assert number == 1


def test_prometheus_can_read_the_guides_relabeling_for_another_admin_port(tmp_path: Path) -> None:
    (tmp_path / "alerts.yaml").write_text(ALERTS.read_text())
    (rule,) = further_relabelings()
    config = scrape_configs()[0]
    config["scrape_configs"][0]["relabel_configs"].append(rule)
    path = tmp_path / "prometheus.yaml"
    path.write_text(yaml.safe_dump(config))
    assert "SUCCESS" in promtool("check", "config", path)


FIRING: dict[str, tuple[dict[str, str], str]] = {
    "RosproxyDown": ({'up{job="rosproxy"}': "1x2 0x20"}, "4m"),
    "RosproxyRestarts": ({'process_start_time_seconds{job="rosproxy"}': "0+1x20"}, "5m"),
    "RosproxyMasterDown": ({"rosproxy_master_up": "1x2 0x20"}, "4m"),
    "RosproxyNodeDown": ({'rosproxy_nodes_down{node="/talker"}': "1x3 stale"}, "6m"),
    "RosproxyRangeFull": ({"rosproxy_leases_free": "2 1 0x20"}, "4m"),
    "RosproxyNodesRefused": ({"rosproxy_range_exhausted_total": "0x2 1x20"}, "3m"),
    "RosproxyNotReachable": ({"rosproxy_setup_faults": "1x20"}, "6m"),
    "RosproxyStrangers": ({'rosproxy_strangers_total{standing="outside"}': "0x2 1x20"}, "3m"),
    "RosproxyOverBound": ({'rosproxy_refused_total{reason="rate"}': "0x2 1x20"}, "3m"),
    "RosproxyConnectionsFail": (
        {'rosproxy_relay_errors_total{reason="node unreachable"}': "0+3x20"}, "10m",
    ),
    "RosproxyFilesRunOut": (
        {f'process_{name}_fds{{job="rosproxy"}}': value
         for name, value in (("open", "900x20"), ("max", "1024x20"))},
        "6m",
    ),
    "RosproxyZenohRoutersDown": ({"rosproxy_zenoh_routers_up": "1x2 0x20"}, "4m"),
    "RosproxyZenohLinkDown": (
        {'rosproxy_zenoh_link_up{peer="tls/cloud:7447"}': "1x2 0x20"}, "8m",
    ),
    "RosproxyZenohCertificateEnds": (
        {'rosproxy_zenoh_certificate_expiry_seconds{file="/link/tls.crt"}': f"{13 * 86400}x20"},
        "11m",
    ),
    "RosproxyOperatorDown": ({'up{job="rosproxy-operator"}': "0x20"}, "3m"),
    "RosproxyOperatorBlind": ({"rosproxy_operator_engine_up": "0x20"}, "6m"),
    "RosproxyOperatorNoLeader": ({'rosproxy_operator_leader{instance="a"}': "1 0x20"}, "4m"),
    "RosproxyOperatorProblems": ({"rosproxy_operator_problems": "2x20"}, "11m"),
    "RosproxyProxyNotRunning": ({'rosproxy_operator_proxies{state="exited"}': "1x20"}, "6m"),
    "RosproxyCertificateEnds": (
        {"rosproxy_operator_certificate_expiry_seconds": "86400x80"}, "61m",
    ),
}  # fmt: skip
"""For each alert: series that make the alert fire, with a value a minute, and the time."""
WELL = {
    'up{job="rosproxy"}': "1x20",
    'up{job="rosproxy-operator"}': "1x20",
    'process_start_time_seconds{job="rosproxy"}': "7x20",
    "rosproxy_master_up": "1x20",
    "rosproxy_leases_free": "1x20",
    "rosproxy_ros2_leases_free": "1x20",
    "rosproxy_ros2_participants_without_port": "0x20",
    "rosproxy_setup_faults": "0x20",
    "rosproxy_range_exhausted_total": "3x20",
    'rosproxy_refused_total{reason="policy"}': "0+9x20",
    'rosproxy_refused_total{reason="not_a_peer"}': "0+9x20",
    'rosproxy_refused_total{reason="rate"}': "3x20",
    'rosproxy_relay_errors_total{reason="denied"}': "0+30x20",
    "rosproxy_zenoh_routers_up": "1x20",
    'rosproxy_zenoh_link_up{peer="robot:7447"}': "0x3 1x17",
    'rosproxy_zenoh_certificate_expiry_seconds{file="/link/tls.crt"}': f"{15 * 86400}x20",
    "rosproxy_operator_engine_up": "1x20",
    'rosproxy_operator_looks_total{outcome="ok"}': "0+2x20",
    'rosproxy_operator_proxies{state="running"}': "3x20",
    'rosproxy_operator_proxies{state="exited"}': "0x20",
    "rosproxy_operator_problems": "0x20",
    'rosproxy_operator_leader{instance="a"}': "1x20",
    'rosproxy_operator_leader{instance="b"}': "0x20",
    "rosproxy_operator_certificate_expiry_seconds": "0x20",
}
"""Nothing is wrong."""


def rule_test(series: dict[str, str], at: str, expected: list[Json]) -> Json:
    """A test in promtool's words: which alerts fire at a time."""
    query = 'count by (alertname) (ALERTS{alertstate="firing"})'
    return {
        "interval": "1m",
        "input_series": [{"series": name, "values": values} for name, values in series.items()],
        "promql_expr_test": [{"expr": query, "eval_time": at, "exp_samples": expected}],
    }


def test_each_alert_fires_when_what_it_names_is_broken(tmp_path: Path) -> None:
    """And no other alert. No alert fires if all is well."""
    assert list(FIRING) == [alert["alert"] for alert in alerts()]
    tests: list[Any] = [rule_test(WELL, "20m", [])]
    for name, (series, at) in FIRING.items():
        fires = [{"labels": f'{{alertname="{name}"}}', "value": 1}]
        tests.append(rule_test(series, at, fires))
    path = tmp_path / "tests.yaml"
    path.write_text(yaml.safe_dump({"rule_files": [str(ALERTS)], "tests": tests}))
    promtool("test", "rules", path)
