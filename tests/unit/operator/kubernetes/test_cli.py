"""The command line of the Kubernetes controller."""

import pytest
from click.testing import CliRunner, Result

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.layers import PolicyMode
from rosproxy.shared.ports import PortRange
from rosproxy_operator import cli
from rosproxy_operator.kubernetes.resources.model import Name
from rosproxy_operator.kubernetes.resources.pod_defaults import PodDefaults
from rosproxy_operator.kubernetes.settings import Bounds, KubernetesSettings

HOOK = ["--webhook-bind=0.0.0.0:9443"]


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> list[KubernetesSettings]:
    """The settings with which the operator would have been run."""
    recorded: list[KubernetesSettings] = []
    monkeypatch.setattr(cli, "_run_kubernetes", lambda settings, *_: recorded.append(settings))
    return recorded


def run(*words: str, **variables: str) -> Result:
    return CliRunner().invoke(cli.main, ["kubernetes", *words], env=variables)


def test_the_defaults(given: list[KubernetesSettings]) -> None:
    assert run().exit_code == 0
    assert given == [KubernetesSettings()]


def test_help_shows_no_empty_word() -> None:
    text = run("--help").stdout
    assert "[Always|IfNotPresent|Never]" in text
    assert "[|" not in text


def test_all_options(given: list[KubernetesSettings]) -> None:
    run(
        "--namespace=one",
        "--namespace=two",
        "--proxy-image=rosproxy:1",
        "--proxy-image-pull-policy=Never",
        '--proxy-pod={"priorityClassName":"high"}',
        "--node-port-range=31000-31999",
        "--ephemeral-range=40000-50000",
        "--resync=5",
        "--allow-master=http://192.0.2.*:11311",
        "--allow-master=http://robot:11311",
        "--max-ports=64",
        "--allow-port-window=11400-19999",
        "--allow-data-plane=auto",
        "--allow-data-plane=kernel",
        "--allow-image=registry.example/*",
        "--slave-control=master",
        "--policy=deny publish /camera/*; deny call *",
        "--policy=deny serve *",
        "--policy-mode=audit",
        "--no-network-policy",
        '--admin-from=[{"podSelector":{}},{"ipBlock":{"cidr":"192.0.2.0/24"}}]',
        "--key-secret=ns/key",
        *HOOK,
        "--webhook-service=ns/wh",
        "--webhook-secret=ns/secret",
        "--webhook-configuration=wh",
        "--admin-bind=127.0.0.1:1",
        "--liveness-bind=127.0.0.1:2",
    )
    (settings,) = given
    assert settings.namespaces == ("one", "two")
    assert settings.plan.image == "rosproxy:1"
    (layer,) = settings.plan.policy
    assert (layer.name, layer.mode) == ("administrator", PolicyMode.AUDIT)
    assert [str(rule) for rule in layer.rules] == [
        *("deny publish /camera/*", "deny call *", "deny serve *")
    ]
    assert settings.plan.image_pull_policy == "Never"
    assert settings.plan.pod == PodDefaults(priority_class="high", resources={}, run_as_user=None)
    assert settings.plan.node_ports == PortRange(31000, 31999)
    assert settings.plan.ephemeral == PortRange(40000, 50000)
    assert settings.plan.bounds == Bounds(
        masters=("http://192.0.2.*:11311", "http://robot:11311"),
        max_ports=64,
        window=PortRange(11400, 19999),
        data_planes=("auto", "kernel"),
        images=("registry.example/*",),
        slave_control="master",
    )
    assert not settings.plan.network_policy
    assert settings.plan.admin_from == ({"podSelector": {}}, {"ipBlock": {"cidr": "192.0.2.0/24"}})
    assert settings.key_secret == Name("ns", "key")
    assert settings.resync == 5.0
    assert settings.admin == HostPort("127.0.0.1", 1)
    assert settings.liveness == HostPort("127.0.0.1", 2)
    assert settings.webhook is not None
    assert settings.webhook.service == Name("ns", "wh")
    assert settings.webhook.secret == Name("ns", "secret")


def test_every_option_has_a_variable(given: list[KubernetesSettings]) -> None:
    run(
        ROSPROXY_NAMESPACE="one two",
        ROSPROXY_PROXY_IMAGE="x:1",
        ROSPROXY_WEBHOOK_BIND="0.0.0.0:1",
        ROSPROXY_WEBHOOK_CERT_DIR="/certs",
    )
    (settings,) = given
    assert settings.namespaces == ("one", "two")
    assert settings.plan.image == "x:1"
    assert settings.webhook is not None
    assert settings.webhook.directory == "/certs"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--namespace=A b"], "--namespace: 'A b' can't be the name of a namespace"),
        (["--proxy-image="], "--proxy-image: '' is not the name of an image"),
        (["--node-port-range=5"], "--node-port-range: '5' is not a range"),
        (["--ephemeral-range=9-1"], "--ephemeral-range: '9-1' must rise"),
        (["--resync=0"], "--resync: 0 s is not between 1 and 86400 s"),
        (["--admin-bind=x"], "--admin-bind: 'x' is not of the form 0.0.0.0:11313"),
        (["--liveness-bind=x"], "--liveness-bind: 'x' is not of the form 0.0.0.0:8080"),
        (["--webhook-bind=x"], "--webhook-bind: 'x' is not of the form 0.0.0.0:9443"),
        (
            ["--allow-master= "],
            "--allow-master: ' ' is not a pattern such as http://192.0.2.*:11311",
        ),
        (["--max-ports=501"], "--max-ports: "),
        (["--allow-data-plane=Kernel"], "--allow-data-plane: "),
        (["--admin-from=all"], "--admin-from: not a JSON list of NetworkPolicyPeers"),
        (['--admin-from=[{"pods":{}}]'], "--admin-from: not a JSON list of NetworkPolicyPeers"),
        (["--proxy-pod=x"], "--proxy-pod: not JSON: "),
        (
            ['--proxy-pod={"labels":{"rosproxy.io/x":""}}'],
            "--proxy-pod: proxy.pod.labels: 'rosproxy.io/x' has a prefix that the operator uses",
        ),
        (["--key-secret=key"], "--key-secret: 'key' is not of the form NAMESPACE/NAME"),
        (HOOK, "--webhook-service: is needed to create"),
        ([*HOOK, "--webhook-service=wh"], "--webhook-service: 'wh' is not of the form NAMESPACE/"),
        (
            [*HOOK, "--webhook-service=ns/wh", "--webhook-configuration=A/b"],
            "--webhook-configuration: 'A/b' can't be the name of an object",
        ),
        (
            [*HOOK, "--webhook-cert-dir=/x", "--webhook-secret=ns/wh"],
            "--webhook-cert-dir: the certificate comes from this directory",
        ),
    ],
)
def test_a_bad_value_names_its_option(words: list[str], told: str) -> None:
    result = run(*words)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"rosproxy-operator: {told}")
    assert result.stderr.count("\n") == 1


def test_a_wrong_word_is_one_line() -> None:
    result = run("--nope")
    assert result.exit_code == 2
    assert result.stderr.startswith("rosproxy-operator: ")
    assert result.stderr.count("\n") == 1


def test_no_cluster_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: object) -> None:
    default_location = "kubernetes.config.kube_config.KUBE_CONFIG_DEFAULT_LOCATION"
    monkeypatch.setattr(default_location, f"{tmp_path}/none")
    monkeypatch.setattr("rosproxy.shared.output.logs.set_up", lambda *_: None)
    monkeypatch.delenv("KUBERNETES_SERVICE_HOST", raising=False)
    result = run()
    assert result.exit_code == 1
    assert result.stderr.startswith("rosproxy-operator: no Kubernetes cluster is configured")
    assert result.stderr.count("\n") == 1


def test_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    result = run()
    assert result.exit_code == 1
    assert "pip install 'rosproxy[kubernetes]'" in result.stderr


def test_a_misspelt_variable_is_told_by_the_doctor_too(caplog: pytest.LogCaptureFixture) -> None:
    run("doctor", ROSPROXY_ALLOW_MASTERS="robot", KUBECONFIG="/nowhere")
    assert "ROSPROXY_ALLOW_MASTERS is not a variable of rosproxy and is ignored" in caplog.text
    assert "did you mean ROSPROXY_ALLOW_MASTER?" in caplog.text
