"""The administrator's bounds of each proxy."""

from dataclasses import fields, replace
from typing import Any

import msgspec
import pytest

from rosproxy.shared.settings import Settings
from rosproxy_operator.cli import main
from rosproxy_operator.common.proxy_bounds import ProxyBounds, make_proxy_bounds
from rosproxy_operator.docker.planner.specs import container_config
from rosproxy_operator.kubernetes.planner import manifests
from tests.run_options import settings_of
from tests.unit.operator.docker.builders import SETTINGS
from tests.unit.operator.docker.test_specs import PROXY
from tests.unit.operator.kubernetes import objects

BOUNDS = ProxyBounds(16, 8, 100, 50)


def taken(settings: Settings) -> ProxyBounds:
    """The bounds of a proxy with these settings."""
    return ProxyBounds(*(getattr(settings, name) for name in ProxyBounds.__struct_fields__))


def test_the_defaults_are_the_proxys_own() -> None:
    own = {field.name: field.default for field in fields(Settings)}
    for name, value in msgspec.structs.asdict(ProxyBounds()).items():
        assert value == own[name]


@pytest.mark.parametrize("command", ["docker", "kubernetes"])
def test_both_operators_have_the_options(command: str) -> None:
    words = ["--proxy-max-buffered=16", "--proxy-max-body=8",
             "--proxy-max-connections-per-source=100",
             "--proxy-max-connections-per-lease=50"]  # fmt: skip
    parse: Any = main.commands[command].make_context
    assert make_proxy_bounds(parse(command, words).params) == BOUNDS
    assert make_proxy_bounds(parse(command, []).params) == ProxyBounds()


def test_a_proxy_in_a_container_has_them() -> None:
    body = container_config(PROXY, replace(SETTINGS, proxy_bounds=BOUNDS), "t", "")
    assert taken(settings_of(dict(variable.split("=", 1) for variable in body["Env"]))) == BOUNDS


def test_a_proxy_in_a_pod_has_them() -> None:
    settings = msgspec.structs.replace(objects.SETTINGS, proxy_bounds=BOUNDS)
    site = objects.site(objects.rosproxy(), objects.node())
    env = manifests.proxy_pod(site, settings)["spec"]["containers"][0]["env"]
    assert taken(settings_of({variable["name"]: variable["value"] for variable in env})) == BOUNDS
