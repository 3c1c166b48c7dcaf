"""The objects of the chart for single values and combinations."""

import ast
import json
import re
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from rosproxy import __version__
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.layers import PolicyMode
from rosproxy.shared.ports import PortRange
from rosproxy_operator.cli import main
from rosproxy_operator.common.proxy_bounds import ProxyBounds
from rosproxy_operator.common.zenoh import client_override
from rosproxy_operator.kubernetes.resources.pod_defaults import PodDefaults
from rosproxy_operator.kubernetes.resources.spec import MOST_PORTS
from rosproxy_operator.kubernetes.settings import (
    Bounds,
    KubernetesSettings,
    WebhookSettings,
    make_kubernetes_settings,
)
from tests.chart.chart import (
    CHART,
    NAMESPACE,
    OPTIONS,
    Json,
    combinations,
    helm,
    merged,
    objects,
    of_kind,
    parse,
    render,
)

CLUSTER_SCOPED = {
    "ClusterRole", "ClusterRoleBinding", "CustomResourceDefinition",
    "MutatingWebhookConfiguration",
}  # fmt: skip
TWO = dict(combinations(2))
THREE = dict(combinations(3))
CHOICES = [(option, name) for option, choices in OPTIONS.items() for name in choices]


@cache
def rendered(combination: str) -> tuple[Json, ...]:
    return tuple(parse(render(TWO[combination])))


@pytest.mark.parametrize(("option", "choice"), CHOICES)
def test_lint(option: str, choice: str) -> None:
    done = helm("lint", CHART, "--strict", "--kube-version", "1.30.0",
                values=OPTIONS[option][choice])  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert "[WARNING]" not in done.stdout


@pytest.mark.parametrize("combination", THREE)
def test_objects(combination: str) -> None:
    """Each combination makes complete and unique objects."""
    manifests = objects(THREE[combination])
    ids = [(manifest["kind"], manifest["metadata"].get("namespace"), manifest["metadata"]["name"])
           for manifest in manifests]  # fmt: skip
    assert len(set(ids)) == len(ids)
    for manifest in manifests:
        labels = manifest["metadata"]["labels"]
        assert labels["app.kubernetes.io/instance"] == "rosproxy"
        assert ("namespace" in manifest["metadata"]) == (manifest["kind"] not in CLUSTER_SCOPED)
        assert "status" not in manifest
    check_references(manifests, THREE[combination])


def check_references(manifests: list[Json], values: Any) -> None:
    """Check that all references lead to existing objects."""
    (deployment,) = [
        manifest
        for manifest in of_kind(manifests, "Deployment")
        if "helm.sh/hook" not in str(manifest)
    ]
    pod = deployment["spec"]["template"]
    (service,) = [
        manifest
        for manifest in of_kind(manifests, "Service")
        if "helm.sh/hook" not in str(manifest)
    ]
    for selecting in (service["spec"]["selector"], deployment["spec"]["selector"]["matchLabels"]):
        assert selecting.items() <= pod["metadata"]["labels"].items()
    ports = {port["name"] for port in pod["spec"]["containers"][0]["ports"]}
    assert {port["targetPort"] for port in service["spec"]["ports"]} <= ports
    roles = {(manifest["kind"], manifest["metadata"].get("namespace"), manifest["metadata"]["name"])
             for manifest in manifests if manifest["kind"] in ("Role", "ClusterRole")}  # fmt: skip
    for binding in [*of_kind(manifests, "RoleBinding"), *of_kind(manifests, "ClusterRoleBinding")]:
        role = binding["roleRef"]
        assert (role["kind"], binding["metadata"].get("namespace"), role["name"]) in roles
        (subject,) = binding["subjects"]
        assert subject["name"] == pod["spec"]["serviceAccountName"]
    for webhook in of_kind(manifests, "MutatingWebhookConfiguration"):
        client = webhook["webhooks"][0]["clientConfig"]["service"]
        assert client["name"] == service["metadata"]["name"]
        assert client["port"] in [port["port"] for port in service["spec"]["ports"]]


@pytest.mark.parametrize("combination", TWO)
def test_arguments(combination: str) -> None:
    """The operator accepts the arguments, which have the meaning of the values."""
    (pod,) = operator(rendered(combination))
    command, *words = pod["containers"][0]["args"]
    context = main.commands[command].make_context(command, words)
    settings = make_kubernetes_settings(context.params)
    values: Json = dict(TWO[combination])
    assert settings.namespaces == tuple(values.get("namespaces", ()))
    image = values.get("proxy", {}).get("image", {"repository": "rosproxy", "tag": __version__})
    assert settings.plan.image == f"{image['repository']}:{image['tag']}"
    ports = {port["name"]: port["containerPort"] for port in pod["containers"][0]["ports"]}
    assert settings.admin.port == ports["metrics"]
    assert settings.liveness.port == ports["liveness"]
    assert settings.resync == (10 if "extraArgs" in values else 300)
    check_bounds(settings, values, pod)
    check_webhook(settings.webhook, ports, list(rendered(combination)))


def check_bounds(settings: KubernetesSettings, values: Json, pod: Json) -> None:
    """Check bounds of RosProxies, and access to proxies."""
    allow = values.get("allow", {})
    (args,) = (container["args"] for container in pod["containers"])
    tested = [arg.partition("=")[2] for arg in args if re.search("--allow-master=.*-test[.]", arg)]
    assert len(tested) == bool(allow)
    expected = ProxyBounds(max_buffered=16, max_connections_per_lease=1_000_000)
    assert settings.plan.proxy_bounds == (expected if allow else ProxyBounds())
    defaults = PodDefaults(
        image_pull_secrets=({"name": "registry"},),
        node_selector={"e": "f"},
        tolerations=({"operator": "Exists"},),
        priority_class="high",
        labels={"a.example/c": "d"},
        annotations={"a": "<b> & 'c' \"d\""},
        run_as_user=None,
    )
    assert settings.plan.pod == (defaults if allow else PodDefaults())
    policy = [(str(rule), layer.mode) for layer in settings.plan.policy for rule in layer.rules]
    assert policy == [("deny publish /camera/* by /driver", PolicyMode.AUDIT)] * bool(allow)
    assert settings.plan.bounds == Bounds(
        masters=(*allow.get("masters", ()), *tested),
        max_ports=allow.get("maxPorts", MOST_PORTS),
        window=PortRange(11400, 19999) if allow else PortRange(1024, 65535),
        data_planes=("auto", "kernel") if allow else ("auto", "splice", "copy"),
        images=tuple(allow.get("images", ())),
        slave_control="master" if allow else "any",
        listen=tuple(allow.get("listen", ())),
        peers=tuple(allow.get("peers", ())),
    )
    assert settings.plan.network_policy
    operator, *peers = settings.plan.admin_from or ()
    own = {"matchLabels": {"kubernetes.io/metadata.name": NAMESPACE}}
    assert operator["namespaceSelector"] == own
    assert list(peers) == ([{"podSelector": {"matchLabels": {"a": "b"}}}] if allow else [])
    assert settings.key_secret is not None
    assert settings.key_secret.namespace == NAMESPACE


def check_webhook(webhook: WebhookSettings | None, ports: Any, manifests: list[Json]) -> None:
    configurations = of_kind(manifests, "MutatingWebhookConfiguration")
    assert bool(webhook) == ("webhook" in ports) == bool(configurations)
    key, *secrets = sorted(secret["metadata"]["name"] for secret in of_kind(manifests, "Secret"))
    assert key.endswith("-key")
    if webhook is None:
        assert secrets == []
    elif webhook.directory:
        assert secrets == []
        assert of_kind(manifests, "Certificate")
    else:
        assert webhook.bind.port == ports["webhook"]
        assert [webhook.secret.name if webhook.secret else ""] == secrets
        assert webhook.configuration == configurations[0]["metadata"]["name"]


def operator(manifests: Any) -> list[Json]:
    return [
        deployment["spec"]["template"]["spec"]
        for deployment in of_kind(list(manifests), "Deployment")
        if deployment["metadata"]["labels"]["app.kubernetes.io/component"] == "operator"
    ]


@pytest.mark.parametrize("combination", TWO)
def test_pods_are_restricted(combination: str) -> None:
    """The Pod Security Standard "restricted", for the operator and for the test's pods."""
    manifests = list(rendered(combination))
    pods = [
        deployment["spec"]["template"]["spec"] for deployment in of_kind(manifests, "Deployment")
    ]
    pods += [pod["spec"] for pod in of_kind(manifests, "Pod")]
    names = {deployment["metadata"]["name"] for deployment in of_kind(manifests, "Deployment")}
    has_master = "rosproxy-operator-test-master" in names  # the test of ROS 2 has none
    assert len(pods) == 3 + has_master
    for pod in pods:
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        assert not pod.keys() & {"hostNetwork", "hostPID", "hostIPC"}
        assert {kind for volume in pod.get("volumes", []) for kind in volume} <= {
            "name", "configMap", "emptyDir", "secret",
        }  # fmt: skip
        for container in pod["containers"]:
            assert container["securityContext"] == {
                "allowPrivilegeEscalation": False,
                "readOnlyRootFilesystem": True,
                "capabilities": {"drop": ["ALL"]},
            }
            assert not [port for port in container.get("ports", []) if "hostPort" in port]


def test_null_leaves_the_user_to_openshift() -> None:
    unset = {"runAsUser": None, "runAsGroup": None, "fsGroup": None}
    manifests = objects({"podSecurityContext": unset, "proxy": {"pod": {"runAsUser": None}}})
    pods = [
        deployment["spec"]["template"]["spec"] for deployment in of_kind(manifests, "Deployment")
    ]
    pods += [pod["spec"] for pod in of_kind(manifests, "Pod")]
    restricted = {"runAsNonRoot": True, "seccompProfile": {"type": "RuntimeDefault"}}
    assert [pod["securityContext"] for pod in pods] == [restricted] * 4
    (pod,) = operator(manifests)
    (text,) = [arg for arg in pod["containers"][0]["args"] if arg.startswith("--proxy-pod=")]
    assert "runAsUser" not in text


def test_two_operators() -> None:
    (deployment,) = [manifest for manifest in of_kind(objects(), "Deployment")
                     if manifest["metadata"]["name"] == "rosproxy-operator"]  # fmt: skip
    assert deployment["spec"]["replicas"] == 2
    assert deployment["spec"]["strategy"]["rollingUpdate"] == {"maxUnavailable": 0, "maxSurge": 1}
    container = deployment["spec"]["template"]["spec"]["containers"][0]
    assert container["livenessProbe"]["httpGet"] == {"path": "/healthz", "port": "liveness"}
    assert container["readinessProbe"]["httpGet"] == {"path": "/readyz", "port": "metrics"}
    assert container["image"] == f"rosproxy-operator:{__version__}"
    assert f"--proxy-image=rosproxy:{__version__}" in container["args"]


def test_operators_are_apart_and_go_one_by_one() -> None:
    manifests = objects()
    (pod,) = operator(manifests)
    (budget,) = of_kind(manifests, "PodDisruptionBudget")
    assert budget["spec"]["maxUnavailable"] == 1
    (apart,) = pod["topologySpreadConstraints"]
    assert apart["topologyKey"] == "kubernetes.io/hostname"
    assert apart["whenUnsatisfiable"] == "ScheduleAnyway"
    assert apart["labelSelector"] == budget["spec"]["selector"]


def test_operators_have_a_right_to_their_lease_alone() -> None:
    manifests = objects()
    (lease,) = of_kind(manifests, "Lease")
    (pod,) = operator(manifests)
    assert "spec" not in lease  # so that upgrades keep the holder
    name = lease["metadata"]["name"]
    assert f"--lease={NAMESPACE}/{name}" in pod["containers"][0]["args"]
    rules = [rule for role in (*of_kind(manifests, "Role"), *of_kind(manifests, "ClusterRole"))
             for rule in role["rules"] if "leases" in rule["resources"]]  # fmt: skip
    assert [(rule.get("resourceNames"), rule["verbs"]) for rule in rules] == [
        ([name], ["get", "patch"]),
        (None, ["create"]),
    ]


def test_webhook() -> None:
    (configuration,) = of_kind(objects(), "MutatingWebhookConfiguration")
    (webhook,) = configuration["webhooks"]
    assert webhook["failurePolicy"] == "Ignore"
    assert webhook["timeoutSeconds"] == 5
    assert webhook["clientConfig"] == {
        "service": {
            "name": "rosproxy-operator",
            "namespace": NAMESPACE,
            "path": "/wire",
            "port": 443,
        }
    }
    assert webhook["objectSelector"]["matchExpressions"] == [
        {"key": "rosproxy.io/inject", "operator": "Exists"},
        {"key": "rosproxy.io/inject", "operator": "NotIn", "values": ["false", ""]},
    ]
    assert webhook["namespaceSelector"]["matchExpressions"] == [
        {"key": "kubernetes.io/metadata.name", "operator": "NotIn", "values": ["kube-system"]}
    ]


def test_webhook_of_some_namespaces() -> None:
    (configuration,) = of_kind(objects({"namespaces": ["a", "b"]}), "MutatingWebhookConfiguration")
    selector = configuration["webhooks"][0]["namespaceSelector"]["matchExpressions"]
    assert selector[1:] == [
        {"key": "kubernetes.io/metadata.name", "operator": "In", "values": ["a", "b"]}
    ]


def test_webhooks_selectors_are_added() -> None:
    more = {
        "matchLabels": {"a": "b"},
        "matchExpressions": [{"key": "c", "operator": "Exists"}],
    }
    values = {
        "failurePolicy": "Fail",
        "objectSelector": more,
        "namespaceSelector": more,
        "annotations": {"d": "e"},
        "certificate": {"source": "cert-manager"},
    }
    (configuration,) = of_kind(objects({"webhook": values}), "MutatingWebhookConfiguration")
    (webhook,) = configuration["webhooks"]
    assert webhook["failurePolicy"] == "Fail"
    for selector in (webhook["objectSelector"], webhook["namespaceSelector"]):
        assert selector["matchLabels"] == {"a": "b"}
        assert selector["matchExpressions"][-1] == {"key": "c", "operator": "Exists"}
    assert len(webhook["objectSelector"]["matchExpressions"]) == 3
    assert len(webhook["namespaceSelector"]["matchExpressions"]) == 2
    annotations = configuration["metadata"]["annotations"]
    assert sorted(annotations) == ["cert-manager.io/inject-ca-from", "d"]


def test_the_operator_in_the_network_of_its_node() -> None:
    values = {
        "hostNetwork": True,
        "webhook": {"port": 10260},
        "metricsPort": 10261,
        "livenessPort": 10262,
    }
    manifests = objects(values)
    (pod,) = operator(manifests)
    assert (pod["hostNetwork"], pod["dnsPolicy"]) == (True, "ClusterFirstWithHostNet")
    ports = {port["name"]: port["containerPort"] for port in pod["containers"][0]["ports"]}
    assert ports == {"webhook": 10260, "metrics": 10261, "liveness": 10262}
    bound = [arg.rpartition("=")[2] for arg in pod["containers"][0]["args"] if "-bind=" in arg]
    assert sorted(bound) == ["0.0.0.0:10260", "0.0.0.0:10261", "0.0.0.0:10262"]
    deployment = next(
        manifest
        for manifest in of_kind(manifests, "Deployment")
        if manifest["metadata"]["name"] == "rosproxy-operator"
    )
    rolling = deployment["spec"]["strategy"]["rollingUpdate"]
    assert rolling == {"maxUnavailable": 1, "maxSurge": 0}  # the ports are taken


def test_secrets_are_empty() -> None:
    """Helm never changes fields that it did not set, so upgrades keep the certificate and
    the key.
    """
    secrets = of_kind(objects(), "Secret")
    assert len(secrets) == 2
    assert not [secret for secret in secrets if {"data", "stringData"} & secret.keys()]
    (configuration,) = of_kind(objects(), "MutatingWebhookConfiguration")
    assert "caBundle" not in configuration["webhooks"][0]["clientConfig"]


def test_the_operator_may_reach_its_proxies() -> None:
    """The peer that proxies' NetworkPolicies let in is the operator's pod."""
    manifests = objects({"podLabels": {"x": "y"}})
    (deployment,) = [manifest for manifest in of_kind(manifests, "Deployment")
                     if manifest["metadata"]["name"] == "rosproxy-operator"]  # fmt: skip
    (pod,) = operator(manifests)
    (text,) = [arg for arg in pod["containers"][0]["args"] if arg.startswith("--admin-from=")]
    (peer,) = json.loads(text.removeprefix("--admin-from="))
    labels = deployment["spec"]["template"]["metadata"]["labels"]
    assert peer["podSelector"]["matchLabels"].items() <= labels.items()
    assert "--no-network-policy" not in pod["containers"][0]["args"]
    off = objects({"proxy": {"networkPolicy": {"enabled": False}}})
    assert "--no-network-policy" in operator(off)[0]["containers"][0]["args"]


def test_helms_test_may_name_its_master() -> None:
    manifests = objects(
        {"namespaces": ["robots"], "allow": {"masters": ["http://192.0.2.*:11311"]}}
    )
    (pod,) = operator(manifests)
    (rosproxy,) = of_kind(manifests, "RosProxy")
    service = rosproxy["spec"]["master"]["service"]["name"]
    master = f"http://{service}.{rosproxy['metadata']['namespace']}.svc:11311"
    assert f"--allow-master={master}" in pod["containers"][0]["args"]


def test_cert_manager() -> None:
    manifests = objects(OPTIONS["webhook"]["cert-manager"])
    (certificate,) = of_kind(manifests, "Certificate")
    (issuer,) = of_kind(manifests, "Issuer")
    assert certificate["spec"]["dnsNames"] == [f"rosproxy-operator.{NAMESPACE}.svc"]
    assert certificate["spec"]["issuerRef"] == {
        "kind": "Issuer", "name": issuer["metadata"]["name"],
    }  # fmt: skip
    (configuration,) = of_kind(manifests, "MutatingWebhookConfiguration")
    assert configuration["metadata"]["annotations"] == {
        "cert-manager.io/inject-ca-from": f"{NAMESPACE}/{certificate['metadata']['name']}"
    }
    (pod,) = operator(manifests)
    (volume,) = pod["volumes"]
    assert volume["secret"]["secretName"] == certificate["spec"]["secretName"]
    (mount,) = pod["containers"][0]["volumeMounts"]
    assert f"--webhook-cert-dir={mount['mountPath']}" in pod["containers"][0]["args"]


def test_own_issuer() -> None:
    manifests = objects(OPTIONS["webhook"]["own-issuer"])
    (certificate,) = of_kind(manifests, "Certificate")
    assert certificate["spec"]["issuerRef"] == {"name": "ca", "kind": "ClusterIssuer"}
    assert not of_kind(manifests, "Issuer")


def test_definition_is_kept() -> None:
    annotation = {"helm.sh/resource-policy": "keep"}
    (kept,) = of_kind(objects(), "CustomResourceDefinition")
    (deleted,) = of_kind(objects({"crds": {"keep": False}}), "CustomResourceDefinition")
    assert kept["metadata"]["annotations"] == annotation
    assert "annotations" not in deleted["metadata"]


@pytest.mark.parametrize("ros", [1, 2, "zenoh"])
def test_global_registry_and_secrets(ros: int | str) -> None:
    values = {
        "global": {"imageRegistry": "mirror.example/", "imagePullSecrets": [{"name": "all"}]},
        "image": {"repository": "registry.example:5000/ros/rosproxy-operator", "tag": "1"},
        "imagePullSecrets": [{"name": "own"}, {"name": "all"}],
        "proxy": {"image": {"tag": "1"}, "pod": {"imagePullSecrets": [{"name": "proxies"}]}},
        "tests": {"ros": ros},
    }
    manifests = objects(values)
    (pod,) = operator(manifests)
    (container,) = pod["containers"]
    assert container["image"] == "mirror.example/ros/rosproxy-operator:1"
    assert "--proxy-image=mirror.example/rosproxy:1" in container["args"]
    assert pod["imagePullSecrets"] == [{"name": "all"}, {"name": "own"}]
    (text,) = [arg for arg in container["args"] if arg.startswith("--proxy-pod=")]
    secrets = json.loads(text.removeprefix("--proxy-pod="))["imagePullSecrets"]
    assert secrets == [{"name": "all"}, {"name": "proxies"}]
    (test,) = of_kind(manifests, "Pod")
    images = {1: "ros:noetic-ros-core-focal", 2: "ros:jazzy-ros-core", "zenoh": "rosproxy:1"}
    assert test["spec"]["containers"][0]["image"] == f"mirror.example/{images[ros]}"
    of_proxies = [{"name": "proxies"}] if ros == "zenoh" else []
    assert test["spec"]["imagePullSecrets"] == [{"name": "all"}, *of_proxies]


@pytest.mark.parametrize("webhook", [True, False])
def test_the_test_of_rmw_zenoh_runs_in_the_proxys_image(webhook: bool) -> None:
    values = {
        "tests": {"ros": "zenoh"},
        "webhook": {"enabled": webhook},
        "proxy": {"image": {"tag": "1", "pullPolicy": "Never"}},
    }
    manifests = objects(values)
    (rosproxy,) = of_kind(manifests, "RosProxy")
    assert rosproxy["spec"]["ros"] == "zenoh"
    assert not {"domain", "ports", "portWindow", "master"} & rosproxy["spec"].keys()
    (test,) = of_kind(manifests, "Pod")
    (container,) = test["spec"]["containers"]
    assert container["command"] == ["python3", "/test/test.py"]
    assert "args" not in container
    assert (container["image"], container["imagePullPolicy"]) == ("rosproxy:1", "Never")
    variables = {v["name"]: v.get("value", "") for v in container["env"]}
    name = rosproxy["metadata"]["name"]
    override = client_override(HostPort(f"rosproxy-{name}", 7448))
    assert variables.get("ZENOH_CONFIG_OVERRIDE") == (None if webhook else override)
    (scripts,) = (m for m in of_kind(manifests, "ConfigMap") if "echo.py" in m.get("data", {}))
    for script in scripts["data"].values():
        ast.parse(script)


def test_namespace_override() -> None:
    manifests = objects({"namespaceOverride": "elsewhere"})
    namespaces = {manifest["metadata"].get("namespace", "elsewhere") for manifest in manifests}
    assert namespaces == {"elsewhere"}
    assert NAMESPACE not in json.dumps(manifests)


def test_extra_objects_may_be_templates() -> None:
    extra = [
        {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "{{ .Release.Name }}-a"}},
        "apiVersion: v1\nkind: ConfigMap\nmetadata: {name: '{{ .Chart.Name }}-b'}",
    ]
    maps = of_kind(objects({"extraObjects": extra}), "ConfigMap")
    assert [m["metadata"]["name"] for m in maps if "namespace" not in m["metadata"]] == [
        "rosproxy-a",
        "rosproxy-operator-b",
    ]


def test_annotations_and_volumes_of_the_operator() -> None:
    values = merged(OPTIONS["pod"]["dressed"], OPTIONS["webhook"]["cert-manager"])
    manifests = objects(values)
    (pod,) = operator(manifests)
    assert [volume["name"] for volume in pod["volumes"]] == ["certificate", "ca"]
    mounts = pod["containers"][0]["volumeMounts"]
    assert [mount["name"] for mount in mounts] == ["certificate", "ca"]
    for kind in ("Deployment", "Service"):
        own = next(m for m in of_kind(manifests, kind)
                   if m["metadata"]["name"] == "rosproxy-proxies")  # fmt: skip
        assert own["metadata"]["annotations"] == {"a": "b"}


@pytest.mark.parametrize(
    ("release", "values", "name"),
    [
        ("rosproxy", {}, "rosproxy-operator"),
        ("rosproxy-operator", {}, "rosproxy-operator"),
        ("my", {}, "my-rosproxy-operator"),
        ("my-rosproxy", {}, "my-rosproxy-operator"),
        ("my-rosproxy-operator", {}, "my-rosproxy-operator"),
        ("my", {"nameOverride": "proxies"}, "my-proxies"),
        ("my", {"fullnameOverride": "other"}, "other"),
        ("r" * 53, {}, f"{'r' * 40}"),
    ],
)
def test_names(release: str, values: Json, name: str) -> None:
    manifests = objects(values, release=release)
    names = {
        manifest["metadata"]["name"]
        for manifest in manifests
        if manifest["kind"] != "CustomResourceDefinition"
    }
    assert name in names
    assert all(object_name.startswith(name) for object_name in names)
    (rosproxy,) = of_kind(manifests, "RosProxy")
    assert len(rosproxy["metadata"]["name"]) <= 46


def test_everything_of_the_test_is_removed() -> None:
    hooks = [
        manifest
        for manifest in objects()
        if "helm.sh/hook" in manifest["metadata"].get("annotations", {})
    ]
    assert sorted(hook["kind"] for hook in hooks) == [
        "ConfigMap", "Deployment", "Deployment", "Pod", "RosProxy", "Service",
    ]  # fmt: skip
    for hook in hooks:
        assert hook["metadata"]["annotations"]["helm.sh/hook"] == "test"
        assert hook["metadata"]["annotations"]["helm.sh/hook-delete-policy"] == (
            "before-hook-creation,hook-succeeded,hook-failed"
        )


@pytest.mark.parametrize(
    ("values", "namespace"),
    [
        ({}, NAMESPACE),
        ({"namespaces": ["a", "b"]}, "a"),
        ({"namespaces": ["a", "b"], "tests": {"namespace": "b"}}, "b"),
    ],
)
def test_the_test_runs_where_the_operator_may(values: Json, namespace: str) -> None:
    hooks = [
        manifest for manifest in objects(values) if "helm.sh/hook" in str(manifest["metadata"])
    ]
    assert {hook["metadata"]["namespace"] for hook in hooks} == {namespace}


def test_the_test_without_a_webhook() -> None:
    """Without a webhook the template wires the test's pod."""
    manifests = objects(merged(OPTIONS["webhook"]["off"]))
    (echo,) = [manifest for manifest in of_kind(manifests, "Deployment")
               if manifest["metadata"]["name"] == "rosproxy-operator-test-echo"]  # fmt: skip
    env = {
        variable["name"]: variable
        for variable in echo["spec"]["template"]["spec"]["containers"][0]["env"]
    }
    assert env["ROS_MASTER_URI"]["value"] == "http://rosproxy-rosproxy-operator-test:11311"


@pytest.fixture(scope="session")
def chart_with_notes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The chart with its notes as an object, because helm shows notes only with a cluster."""
    copy = tmp_path_factory.mktemp("charts") / "rosproxy"
    shutil.copytree(CHART, copy)
    (copy / "templates/NOTES.txt").rename(copy / "notes.txt")
    (copy / "templates/notes.yaml").write_text(
        'notes: {{ tpl (.Files.Get "notes.txt") . | quote }}'
    )
    return copy


@pytest.mark.parametrize(("option", "choice"), CHOICES)
def test_notes(option: str, choice: str, chart_with_notes: Path) -> None:
    """The notes tell the next commands, and what the values make different."""
    values = OPTIONS[option][choice]
    (notes,) = objects(values, "--show-only", "templates/notes.yaml", chart=chart_with_notes)
    text = notes["notes"]
    assert f"helm -n {NAMESPACE} test rosproxy" in text
    assert f"kubectl -n {NAMESPACE} rollout status deployment/" in text
    assert "rosproxy.io/inject" in text
    port = values.get("metricsPort", 11313)
    assert f"http://localhost:{port}/ in a browser" in text
    assert re.search(f"kubectl -n {NAMESPACE} port-forward deployment/\\S+ {port}\n", text)
    assert ("webhook.enabled" in text) == (choice == "off")
    assert ("crds.install" in text) == (option == "crds" and choice == "elsewhere")
    assert ("kubectl delete crd" in text) == (option != "crds" or choice == "installed")
    # First the RosProxies: without their end, the nodes stay registered at the master.
    deleted = re.findall(r"kubectl delete (\w+)", text)
    assert deleted in ([], ["rosproxies", "crd"])
    assert ("-n robots apply" in text) == (choice == "two")
    assert 'write "ros: 2" instead' in text


@pytest.mark.parametrize(
    ("masters", "uri"),
    [
        ([], "http://robot:11311"),
        (["http://192.0.2.7:11311", "http://*:11311"], "http://192.0.2.7:11311"),
        (["http://192.0.2.*:11311"], "MASTER_URI"),
    ],
)
def test_notes_name_an_allowed_master(masters: list[str], uri: str, chart_with_notes: Path) -> None:
    values = {"allow": {"masters": masters}}
    (notes,) = objects(values, "--show-only", "templates/notes.yaml", chart=chart_with_notes)
    assert f"      uri: {uri}\n" in notes["notes"]
    assert all(master in notes["notes"] for master in masters)
    assert ("allow.masters" in notes["notes"]) == bool(masters)
    assert ("Replace MASTER_URI" in notes["notes"]) == (uri == "MASTER_URI")
