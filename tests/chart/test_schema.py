"""The schema refuses wrong values, with a message that names the value."""

import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
import yaml  # type: ignore[import-untyped]

from rosproxy_operator.proxy_spec.spec import OWN_SPEC, WISHES, words
from tests.chart.chart import CHART, Json, helm, objects, of_kind

BAD: list[tuple[Json, str]] = [
    ({"imag": {}}, "imag"),
    ({"image": {"repo": "x"}}, "repo"),
    ({"image": {"repository": ""}}, "image/repository"),
    ({"image": {"tag": "a b"}}, "image/tag"),
    ({"image": {"tag": 1.2}}, "image/tag"),
    ({"image": {"digest": "sha256:12"}}, "image/digest"),
    ({"image": {"pullPolicy": "Sometimes"}}, "image/pullPolicy"),
    ({"proxy": {"image": {"pullPolicy": "never"}}}, "proxy/image/pullPolicy"),
    ({"proxy": {"slaveControl": "master"}}, "proxy/slaveControl"),
    ({"proxy": {"bounds": {"maxConnectionsPerLease": 8}}}, "proxy/bounds/maxConnectionsPerLease"),
    ({"proxy": {"networkPolicy": {"metricsFrom": [{"pods": {}}]}}}, "metricsFrom/0"),
    ({"proxy": {"networkPolicy": {"metricsFrom": [{}]}}}, "metricsFrom/0"),
    ({"proxy": {"pod": {"affinity": {}}}}, "affinity"),
    ({"proxy": {"pod": {"labels": {"rosproxy.io/inject": "true"}}}}, "labels"),
    ({"proxy": {"pod": {"labels": {"a": "b" * 64}}}}, "labels/a"),
    ({"proxy": {"pod": {"annotations": {"app.kubernetes.io/name": "x"}}}}, "annotations"),
    ({"proxy": {"pod": {"tolerations": [{"effect": "Never"}]}}}, "tolerations/0/effect"),
    ({"proxy": {"pod": {"resources": {"limits": {"memory": "1 GB"}}}}}, "limits/memory"),
    ({"proxy": {"pod": {"runAsUser": 0}}}, "pod/runAsUser"),
    ({"podSecurityContext": {"runAsUsr": 1}}, "runAsUsr"),
    ({"securityContext": {"capabilities": {"drop": "ALL"}}}, "capabilities/drop"),
    ({"policy": {"rules": "deny publish *"}}, "policy/rules"),
    ({"policy": {"rules": ["deny topic *"]}}, "policy/rules/0"),
    ({"policy": {"rules": ["deny publish /a;deny serve *"]}}, "policy/rules/0"),
    ({"policy": {"mode": "audit"}}, "policy/mode"),
    ({"allow": {"masters": ["robot:11311"]}}, "allow/masters/0"),
    ({"allow": {"maxPorts": 501}}, "allow/maxPorts"),
    ({"allow": {"portWindow": 11400}}, "allow/portWindow"),
    ({"allow": {"dataPlanes": ["kernel"]}}, "allow/dataPlanes/0"),
    ({"allow": {"dataPlanes": []}}, "allow/dataPlanes"),
    ({"allow": {"images": ["a b"]}}, "allow/images/0"),
    ({"imagePullSecrets": ["registry"]}, "imagePullSecrets/0"),
    ({"namespaces": "robots"}, "namespaces"),
    ({"namespaces": ["Robots"]}, "namespaces/0"),
    ({"namespaces": ["a", "a"]}, "namespaces"),
    ({"namespaces": ["kube-system"]}, "namespaces/0"),
    ({"crds": {"install": "yes"}}, "crds/install"),
    ({"ports": {"nodePortRange": "30000"}}, "ports/nodePortRange"),
    ({"ports": {"ephemeralRange": "32768 60999"}}, "ports/ephemeralRange"),
    ({"webhook": {"timeoutSeconds": 31}}, "webhook/timeoutSeconds"),
    ({"webhook": {"failurePolicy": "fail"}}, "webhook/failurePolicy"),
    ({"webhook": {"objectSelector": {"app": "ros"}}}, "app"),
    ({"webhook": {"port": 443}}, "webhook/port"),
    ({"hostNetwork": "yes"}, "hostNetwork"),
    ({"webhook": {"certificate": {"source": "self"}}}, "webhook/certificate/source"),
    (
        {"webhook": {"certificate": {"certManager": {"issuerRef": {"kind": "Issuer"}}}}},
        "webhook/certificate/certManager/issuerRef",
    ),
    ({"webhook": {"certificate": {"certManager": {"duration": "90d"}}}}, "certManager/duration"),
    ({"serviceAccount": {"name": "A b"}}, "serviceAccount/name"),
    ({"rbac": {"agregate": True}}, "agregate"),
    ({"log": {"level": "loud"}}, "log/level"),
    ({"log": {"format": "xml"}}, "log/format"),
    ({"resources": {"memory": "1Gi"}}, "memory"),
    ({"commonLabels": {"app.kubernetes.io/name": "x"}}, "commonLabels"),
    ({"podLabels": {"a": 1}}, "podLabels/a"),
    ({"extraArgs": "--resync=1"}, "extraArgs"),
    ({"extraEnv": [{"value": "x"}]}, "extraEnv/0"),
    ({"replicas": -1}, "replicas"),
    ({"podDisruptionBudget": {"maxUnavailable": -1}}, "podDisruptionBudget/maxUnavailable"),
    ({"topologySpreadConstraints": {}}, "topologySpreadConstraints"),
    ({"affinity": {"nodeAffinty": {}}}, "nodeAffinty"),
    ({"tolerations": [{"keys": "a"}]}, "keys"),
    ({"podSecurityContext": {"seccompProfile": {"type": "Runtime"}}}, "seccompProfile/type"),
    ({"extraVolumeMounts": [{"name": "a"}]}, "mountPath"),
    ({"serviceMonitor": {"relabelings": [{"target": "a"}]}}, "target"),
    ({"webhook": {"objectSelector": {"matchExpressions": [{"key": "a"}]}}}, "operator"),
    ({"allow": {"peers": ["robot:7447"]}}, "allow/peers/0"),
    ({"allow": {"listen": ["ClusterIP"]}}, "allow/listen/0"),
    ({"networkPolicy": {"metricsFrom": [{}]}}, "networkPolicy/metricsFrom/0"),
    ({"serviceMonitor": {"interval": "often"}}, "serviceMonitor/interval"),
    ({"serviceMonitor": {"scrapeTimeout": "5"}}, "serviceMonitor/scrapeTimeout"),
    ({"serviceMonitor": {"spec": {"jobLabel": "app"}}}, "jobLabel"),
    ({"serviceMonitor": {"spec": {"scrapeProtocols": []}}}, "scrapeProtocols"),
    ({"serviceMonitor": {"spec": {"sampleLimit": "5000"}}}, "spec/sampleLimit"),
    ({"serviceMonitor": {"endpoint": {"path": "/"}}}, "path"),
    ({"serviceMonitor": {"endpoint": {"honorTimestamps": True}}}, "honorTimestamps"),
    ({"serviceMonitor": {"endpoint": {"tlsConfig": {}}}}, "serviceMonitor/endpoint"),
    ({"serviceMonitor": {"endpoint": {"scheme": "http", "tlsConfig": {}}}}, "endpoint/scheme"),
    ({"podMonitor": {"spec": {"targetLabels": ["team"]}}}, "spec/targetLabels"),
    (
        {"podMonitor": {"endpoint": {"scheme": "https", "tlsConfig": {"caFile": "/ca.crt"}}}},
        "tlsConfig/caFile",
    ),
    ({"prometheusRule": {"namespace": "A"}}, "prometheusRule/namespace"),
    ({"dashboard": {"namespace": "A"}}, "dashboard/namespace"),
    ({"global": {"imagePullSecrets": ["registry"]}}, "imagePullSecrets/0"),
    ({"namespaceOverride": "A"}, "namespaceOverride"),
    ({"extraVolumes": [{"emptyDir": {}}]}, "extraVolumes/0"),
    ({"podMonitor": {"interval": "often"}}, "podMonitor/interval"),
    ({"prometheusRule": {"runbook": "docs/guide/alerts.md"}}, "prometheusRule/runbook"),
    ({"dashboard": {"labels": {"grafana_dashboard": 1}}}, "dashboard/labels/grafana_dashboard"),
    ({"tests": {"timeoutSeconds": 0}}, "tests/timeoutSeconds"),
    ({"fullnameOverride": "Rosproxy"}, "fullnameOverride"),
]


@pytest.mark.parametrize(("values", "named"), BAD)
def test_refused(values: Json, named: str) -> None:
    done = helm("template", "x", CHART, "--kube-version", "1.30.0", values=values)
    assert done.returncode != 0
    assert named.rpartition("/")[2] in done.stderr
    assert "values don't meet the specifications of the schema" in done.stderr


NO_EFFECT: list[tuple[Json, str]] = [
    ({"metricsPort": 8080}, "livenessPort: the ports [9443 8080 8080] are not different. Choose"),
    (
        {"networkPolicy": {"metricsFrom": [{"podSelector": {}}]}},
        " networkPolicy.metricsFrom: has an effect only with networkPolicy.enabled: true. Set",
    ),
    (
        {"proxy": {"networkPolicy": {"enabled": False, "metricsFrom": [{"podSelector": {}}]}}},
        "proxy.networkPolicy.metricsFrom: has an effect only with proxy.networkPolicy.enabled",
    ),
    (
        {"webhook": {"certificate": {"certManager": {"issuerRef": {"name": "ca"}}}}},
        "certManager.issuerRef: has an effect only with webhook.certificate.source: cert-manager",
    ),
    (
        {"webhook": {"certificate": {"certManager": {"duration": "1h"}}}},
        "certManager.duration: has an effect only with webhook.certificate.source: cert-manager",
    ),
    *(
        ({"webhook": {"enabled": False, **values}}, "has an effect only with webhook.enabled: true")
        for values in (
            {"timeoutSeconds": 6},
            {"failurePolicy": "Fail"},
            {"objectSelector": {"matchLabels": {"a": "b"}}},
            {"annotations": {"a": "b"}},
            {"port": 9444},
            {"certificate": {"source": "cert-manager"}},
        )
    ),
    *(
        ({group: {"labels": {"a": "b"}}}, f"{group}.labels: has an effect only with {group}.")
        for group in ("serviceMonitor", "podMonitor", "prometheusRule", "dashboard")
    ),
    (
        {"prometheusRule": {"runbook": "https://docs.example/alerts"}},
        "prometheusRule.runbook: has an effect only with prometheusRule.enabled: true. Set",
    ),
    (
        {"podDisruptionBudget": {"enabled": False, "maxUnavailable": 2}},
        "maxUnavailable: has an effect only with podDisruptionBudget.enabled: true. Set this",
    ),
    *(
        ({"tests": {"ros": ros, "image": "a"}}, "tests.image: has an effect only with tests.ros: 1")
        for ros in (2, "zenoh")
    ),
    *(
        (
            {"tests": {"ros": ros, "ros2Image": "a"}},
            "ros2Image: has an effect only with tests.ros: ",
        )
        for ros in (1, "zenoh")
    ),
    ({"global": {"imageRegistri": "a"}}, "global.imageRegistri: is unknown, and the release has"),
    ({"policy": {"mode": "Audit"}}, "policy.mode: has no effect without rules. Add policy.rules"),
    ({"crds": {"install": False, "keep": False}}, "crds.keep: has no effect if the release does"),
    ({"serviceAccount": {"create": False}}, "serviceAccount.name: is empty, and the chart"),
    (
        {"serviceAccount": {"create": False, "name": "a", "annotations": {"b": "c"}}},
        "serviceAccount.annotations: the chart creates no ServiceAccount. Annotate",
    ),
    ({"rbac": {"create": False, "aggregate": True}}, "rbac.aggregate: the chart creates no roles"),
]


@pytest.mark.parametrize(("values", "told"), NO_EFFECT)
def test_values_without_effect_are_refused(values: Json, told: str) -> None:
    done = helm("template", "x", CHART, "--kube-version", "1.30.0", values=values)
    assert done.returncode != 0
    assert told in done.stderr


@pytest.mark.parametrize(
    ("values", "path"),
    [
        ({"image": {"repository": None}}, "image.repository"),
        ({"proxy": {"image": {"repository": None}}}, "proxy.image.repository"),
        ({"tests": {"image": None}}, "tests.image"),
        ({"tests": {"ros": 2, "ros2Image": None}}, "tests.ros2Image"),
        ({"tests": {"ros": None}}, "tests.ros"),
        ({"tests": {"timeoutSeconds": None}}, "tests.timeoutSeconds"),
    ],
)
def test_null_is_refused_where_the_chart_needs_a_value(values: Json, path: str) -> None:
    """Helm removes the default before it asks the schema. The image of a pod was empty."""
    done = helm("template", "x", CHART, "--kube-version", "1.30.0", values=values)
    assert done.returncode != 0
    assert f"{path}: is null, which removes the default" in done.stderr


def off(*names: str) -> Json:
    """Values that switch these groups off."""
    return {name: {"enabled": False} for name in names}


@pytest.mark.parametrize(
    "values",
    [
        {**off("webhook", "podDisruptionBudget"), "proxy": off("networkPolicy")},
        *({"tests": {"ros": ros}} for ros in (1, 2, "zenoh")),
        *(
            {"tests": {"ros": ros, image: None}}
            for ros, image in ((1, "ros2Image"), (2, "image"), ("zenoh", "image"))
        ),
    ],
)
def test_defaults_without_effect_are_accepted(values: Json) -> None:
    """`helm upgrade --reuse-values` gives all of them."""
    objects(values)


def test_global_values_of_other_charts_of_a_parent_are_accepted(tmp_path: Path) -> None:
    about = {"apiVersion": "v2", "name": "parent", "version": "0.1.0"}
    (tmp_path / "Chart.yaml").write_text(json.dumps(about))
    shutil.copytree(CHART, tmp_path / "charts" / CHART.name)
    manifests = objects({"global": {"imageRegistry": "a.example", "other": 1}}, chart=tmp_path)
    images = {container["image"].partition("/")[0] for manifest in of_kind(manifests, "Deployment")
              for container in manifest["spec"]["template"]["spec"]["containers"]}  # fmt: skip
    assert images == {"a.example"}


def test_values_about_the_options_of_a_proxy_are_the_operators() -> None:
    schema = json.loads((CHART / "values.schema.json").read_text())["properties"]
    values = yaml.safe_load((CHART / "values.yaml").read_text())
    planes = schema["allow"]["properties"]["dataPlanes"]["items"]
    assert planes["enum"] == capitalized(words("data_plane"))
    assert values["allow"]["dataPlanes"] == capitalized(WISHES["data_plane"].free)
    control = schema["proxy"]["properties"]["slaveControl"]
    assert control["enum"] == capitalized(words("slave_control"))
    assert [values["proxy"]["slaveControl"]] == capitalized([OWN_SPEC.slave_control])


def capitalized(words: Iterable[str]) -> list[str]:
    """Words in the form of Kubernetes."""
    return [word.capitalize() for word in words]


def test_every_value_is_in_the_schema() -> None:
    """And each group refuses other keys."""
    schema = json.loads((CHART / "values.schema.json").read_text())
    values = yaml.safe_load((CHART / "values.yaml").read_text())
    assert missing(values, schema) == [".global"]  # shared with the other charts of a parent


def missing(values: Any, schema: Json, path: str = "") -> list[str]:
    """The values that the schema does not name, and the groups that take anything."""
    properties = schema.get("properties")
    if not isinstance(values, dict) or not values or properties is None:
        return []
    paths = [] if schema.get("additionalProperties") is False else [path]
    for name, value in values.items():
        value_path = f"{path}.{name}"
        paths += (
            missing(value, properties[name], value_path) if name in properties else [value_path]
        )
    return paths
