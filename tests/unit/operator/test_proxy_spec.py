"""The options of a proxy: declared once, and the same on both engines."""

from typing import Any

import pytest

from rosproxy.setting_kinds import declared
from rosproxy.settings import Settings
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.environment import environment
from rosproxy_operator.proxy_spec.spec import OWN_SPEC, WISHES, ProxySpec, merged, words

SETTINGS = {setting.field: setting for setting in declared(Settings)}
BOTH = {"direction": "both"}


@pytest.mark.parametrize("name", WISHES)
def test_an_option_is_a_setting_of_the_proxy_and_of_the_operator(name: str) -> None:
    assert words(name) == SETTINGS[name].words
    assert {*WISHES[name].precedence} == {*(words(name) or (True, False))}
    default = getattr(OWN_SPEC, name)
    assert default == SETTINGS[name].default == getattr(PlanSettings(), name)


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
    ],
)
def test_containers_of_one_proxy(wishes: Any, defaults: ProxySpec, spec: ProxySpec) -> None:
    assert merged(wishes, defaults) == spec


def test_variables_tell_what_is_not_the_default() -> None:
    told = {"master_port": 11311, "direction": "out", "udp": True, "ros2_peer": ("a", "b:1")}
    assert environment("docker", {**told, "cleanup_after": 0.0}, ("master_port",)) == {
        "ROSPROXY_OPERATOR": "docker",
        "ROSPROXY_MASTER_PORT": "11311",
        "ROSPROXY_UDP": "1",
        "ROSPROXY_ROS2_PEERS": "a b:1",
        "ROSPROXY_CLEANUP_AFTER": "0",
    }
