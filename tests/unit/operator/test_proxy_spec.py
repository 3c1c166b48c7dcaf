"""The options of a proxy: declared once, and the same on both engines."""

from typing import Any

import pytest

from rosproxy.shared.setting_kinds import declared
from rosproxy.shared.settings import Settings
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.environment import environment
from rosproxy_operator.proxy_spec.spec import OWN_SPEC, WISHES, ProxySpec, merged, options, words

SETTINGS = {setting.field: setting for setting in declared(Settings)}
BOTH = {"direction": "both"}


@pytest.mark.parametrize("name", WISHES)
def test_an_option_is_a_setting_of_the_proxy(name: str) -> None:
    assert words(name) == SETTINGS[name].words
    assert {*WISHES[name].precedence} == {*(words(name) or (True, False))}
    assert getattr(OWN_SPEC, name) == SETTINGS[name].default


@pytest.mark.parametrize("name", WISHES)
def test_the_operator_has_an_option_for_containers_without_the_label(name: str) -> None:
    """The exception is the log level: the operator's ``--log-level`` is for its own log."""
    has_option = name != "log_level"
    assert hasattr(PlanSettings(), name) == has_option
    assert not has_option or getattr(PlanSettings(), name) == getattr(OWN_SPEC, name)


@pytest.mark.parametrize(
    ("wishes", "defaults", "spec"),
    [
        ([], ProxySpec("copy", "both"), ProxySpec("copy", "both")),
        ([{}, {"data_plane": "copy"}], ProxySpec("kernel"), ProxySpec("copy")),
        ([{"data_plane": "copy"}, {"data_plane": "splice"}], OWN_SPEC, ProxySpec("splice")),
        ([{}, {"direction": "out"}], ProxySpec(direction="both"), ProxySpec(direction="both")),
        ([{"direction": "out"}], ProxySpec(direction="both"), ProxySpec()),
        ([{"slave_control": "master"}, {}], OWN_SPEC, ProxySpec(slave_control="master")),
        ([{"udp": True}, BOTH], OWN_SPEC, ProxySpec(direction="both", udp=True)),
        ([{"udp": True}], OWN_SPEC, OWN_SPEC),
        ([{"log_level": "error"}, {"log_level": "debug"}], OWN_SPEC, ProxySpec(log_level="debug")),
        ([{"log_level": "warning"}], OWN_SPEC, ProxySpec(log_level="warning")),
        ([{"log_level": "warning"}, {}], OWN_SPEC, OWN_SPEC),
        ([{"log_level": "info"}, {"log_level": "warning"}], OWN_SPEC, OWN_SPEC),
    ],
)
def test_containers_of_one_proxy(wishes: Any, defaults: ProxySpec, spec: ProxySpec) -> None:
    assert merged(wishes, defaults) == spec


@pytest.mark.parametrize(
    ("ros", "names"),
    [
        ("1", {"data_plane", "direction", "udp", "slave_control", "log_level"}),
        ("2", {"data_plane", "direction", "log_level"}),
        ("zenoh", {"log_level"}),
    ],
)
def test_options_of_a_version_of_ros(ros: str, names: set[str]) -> None:
    assert options(OWN_SPEC, ros).keys() == names


def test_variables_tell_what_is_not_the_default() -> None:
    told = {"master_port": 11311, "direction": "out", "udp": True, "ros2_peer": ("a", "b:1")}
    assert environment("docker", {**told, "cleanup_after": 0.0}, ("master_port",)) == {
        "ROSPROXY_OPERATOR": "docker",
        "ROSPROXY_MASTER_PORT": "11311",
        "ROSPROXY_UDP": "1",
        "ROSPROXY_ROS2_PEERS": "a b:1",
        "ROSPROXY_CLEANUP_AFTER": "0",
    }
