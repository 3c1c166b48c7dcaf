"""The Helm chart, rendered without a cluster."""

import itertools
import json
import os
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

ROOT = Path(__file__).resolve().parents[2]
CHART = ROOT / "charts/rosproxy-operator"
NAMESPACE = "rosproxy-system"
KUBERNETES = "1.30.0"
"""Without this version, a helm that its makefile did not build assumes an ancient cluster."""

Json = dict[str, Any]
Values = Mapping[str, Any]

OPTIONS: dict[str, dict[str, Values]] = {
    "webhook": {
        "self-signed": {},
        "off": {"webhook": {"enabled": False}},
        "strict": {
            "webhook": {
                "failurePolicy": "Fail",
                "objectSelector": {"matchLabels": {"a": "b"}},
                "namespaceSelector": {"matchExpressions": [{"key": "c", "operator": "Exists"}]},
                "annotations": {"d": "e"},
                "port": 9444,
            }
        },
        "cert-manager": {"webhook": {"certificate": {"source": "cert-manager"}}},
        "own-issuer": {
            "webhook": {
                "certificate": {
                    "source": "cert-manager",
                    "certManager": {"issuerRef": {"name": "ca", "kind": "ClusterIssuer"}},
                }
            }
        },
    },
    "namespaces": {"all": {}, "two": {"namespaces": ["robots", "arms"]}},
    "crds": {
        "installed": {},
        "deleted": {"crds": {"keep": False}},
        "elsewhere": {"crds": {"install": False}},
    },
    "rbac": {
        "made": {},
        "aggregated": {
            "rbac": {"aggregate": True},
            "serviceAccount": {"annotations": {"a.example/role": "x"}},
        },
        "elsewhere": {
            "rbac": {"create": False},
            "serviceAccount": {"create": False, "name": "mine"},
        },
    },
    "extras": {
        "none": {},
        "all": {
            "serviceMonitor": {
                "enabled": True,
                "namespace": "monitoring",
                "labels": {"release": "p"},
                "annotations": {"a": "b"},
                "interval": "15s",
                "scrapeTimeout": "5s",
                "relabelings": [{"targetLabel": "cluster", "replacement": "c"}],
                "spec": {"targetLabels": ["team"], "sampleLimit": 5000},
                "endpoint": {"scheme": "https", "tlsConfig": {"caFile": "/ca.crt"}},
            },
            "podMonitor": {
                "enabled": True,
                "labels": {"release": "p"},
                "interval": "1m30s",
                "honorLabels": True,
                "metricRelabelings": [{"action": "labeldrop", "regex": "x"}],
                "spec": {"podTargetLabels": ["team"], "attachMetadata": {"node": True}},
                "endpoint": {"enableHttp2": False},
            },
            "prometheusRule": {
                "enabled": True,
                "namespace": "monitoring",
                "annotations": {"a": "b"},
                "runbook": "https://docs.example/alerts",
            },
            "dashboard": {
                "enabled": True,
                "namespace": "monitoring",
                "annotations": {"grafana_folder": "Robots"},
            },
            "podDisruptionBudget": {"enabled": False},
            "networkPolicy": {
                "enabled": True,
                "metricsFrom": [{"podSelector": {"matchLabels": {"app": "prometheus"}}}],
            },
        },
    },
    "pod": {
        "plain": {},
        "dressed": {
            "nameOverride": "proxies",
            "commonLabels": {"team": "arms"},
            "image": {"repository": "mine/operator", "digest": f"sha256:{'0' * 64}"},
            "proxy": {
                "image": {"repository": "mine/proxy", "tag": "9", "pullPolicy": "Always"},
                "pod": {
                    "imagePullSecrets": [{"name": "registry"}],
                    "nodeSelector": {"e": "f"},
                    "tolerations": [{"operator": "Exists"}],
                    "priorityClassName": "high",
                    "labels": {"a.example/c": "d"},
                    "annotations": {"a": "<b> & 'c' \"d\""},
                    "runAsUser": None,
                },
                "slaveControl": "Master",
                "bounds": {"maxBuffered": 16, "maxConnectionsPerLease": 1000000},
                "networkPolicy": {"metricsFrom": [{"podSelector": {"matchLabels": {"a": "b"}}}]},
            },
            "allow": {
                "masters": ["http://192.0.2.*:11311", "http://[fd00::*]:*"],
                "maxPorts": 64,
                "portWindow": "11400-19999",
                "dataPlanes": ["Auto", "Kernel"],
                "images": ["registry.example/*"],
                "listen": ["NodePort"],
                "peers": ["192.0.2.*", "[fd00::*]"],
            },
            "policy": {"rules": ["deny publish /camera/* by /driver"], "mode": "Audit"},
            "imagePullSecrets": [{"name": "registry"}],
            "podAnnotations": {"a": "b"},
            "podLabels": {"c": "d"},
            "nodeSelector": {"e": "f"},
            "tolerations": [{"operator": "Exists"}],
            "affinity": {"nodeAffinity": {}},
            "replicas": 3,
            "topologySpreadConstraints": [
                {
                    "maxSkew": 1,
                    "topologyKey": "topology.kubernetes.io/zone",
                    "whenUnsatisfiable": "DoNotSchedule",
                    "labelSelector": {"matchLabels": {"c": "d"}},
                }
            ],
            "priorityClassName": "high",
            "extraEnv": [{"name": "HTTPS_PROXY", "value": "http://proxy:3128"}],
            "extraArgs": ["--resync=10"],
            "extraVolumes": [{"name": "ca", "configMap": {"name": "ca"}}],
            "extraVolumeMounts": [{"name": "ca", "mountPath": "/ca", "readOnly": True}],
            "deploymentAnnotations": {"a": "b"},
            "serviceAnnotations": {"a": "b"},
            "log": {"level": "debug", "format": "json"},
            "tests": {
                "ros": 2,
                "namespace": "arms",
                "imagePullPolicy": "Never",
                "imagePullSecrets": [{"name": "registry"}],
                "nodeSelector": {"e": "f"},
                "tolerations": [{"operator": "Exists"}],
            },
        },
    },
}
"""The choices that the chart offers, with values that make each."""


def helm(*arguments: str | Path, values: Values | None = None) -> subprocess.CompletedProcess[str]:
    """Run helm, with these values if there are any."""
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        json.dump(values or {}, file)
        file.flush()
        given = ["--values", file.name] if values else []
        command = [str(program()), *map(str, arguments), *given]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


def program() -> Path:
    """The path of helm, which `scripts/install-kubernetes.sh` installs."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("CLUSTER_BIN") or Path(cache) / "rosproxy/cluster") / "helm"


def render(
    values: Values | None = None, *options: str, release: str = "rosproxy", chart: Path = CHART
) -> str:
    """The chart's objects for these values, as YAML."""
    words = ("template", release, chart, "--namespace", NAMESPACE, "--kube-version", KUBERNETES)
    done = helm(*words, *options, values=values)
    assert done.returncode == 0, done.stderr
    return done.stdout


def objects(values: Values | None = None, *options: str, **more: Any) -> list[Json]:
    """The objects of the chart. ``more`` goes to `render`."""
    return parse(render(values, *options, **more))


def parse(text: str) -> list[Json]:
    return [document for document in yaml.load_all(text, Loader=Strict) if document]


def of_kind(manifests: list[Json], kind: str) -> list[Json]:
    return [manifest for manifest in manifests if manifest["kind"] == kind]


def combinations(most: int) -> Iterator[tuple[str, Values]]:
    """Few combinations in which any ``most`` choices meet, as pairs of a name and values."""
    return map(_combined, _covering(most))


def _combined(names: tuple[str, ...]) -> tuple[str, Values]:
    pairs = zip(OPTIONS.values(), names, strict=True)
    return " ".join(names), merged(*(choices[name] for choices, name in pairs))


def _covering(most: int) -> Iterator[tuple[str, ...]]:
    """Always the combination next in which most meetings are new, while there are any."""
    every = {
        names: set(itertools.combinations(enumerate(names), most))
        for names in itertools.product(*OPTIONS.values())
    }
    left = set().union(*every.values())
    while left:
        best = max(every, key=lambda names: len(every[names] & left))
        left -= every[best]
        yield best


def merged(*layers: Values) -> Values:
    """Merge values like helm."""
    whole: Json = {}
    for layer in layers:
        for key, value in layer.items():
            both = isinstance(value, Mapping) and isinstance(whole.get(key), Mapping)
            whole[key] = merged(whole[key], value) if both else value
    return whole


class Strict(yaml.CSafeLoader):  # type: ignore[misc]
    """YAML in which no key stands twice in a map, which the API server would refuse."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        keys = [key.value for key, _ in node.value]
        doubled = {key for key in keys if keys.count(key) > 1}
        assert not doubled, f"{doubled} stand twice:{node.start_mark}"
        return super().construct_mapping(node, deep)
