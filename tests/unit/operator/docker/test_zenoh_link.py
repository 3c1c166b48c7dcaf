"""Links of rmw_zenoh to other sites: the options, the label, and the proxy."""

from dataclasses import replace
from typing import Any

import pytest

from rosproxy.shared.policy.rules import parse_rules
from rosproxy.shared.settings import MOST_ZENOH_LINKS
from rosproxy_operator.cli import main
from rosproxy_operator.docker.engine_json import read_making
from rosproxy_operator.docker.planner.actions import Create
from rosproxy_operator.docker.planner.own_containers import forgery_reason
from rosproxy_operator.docker.planner.specs import (
    container_config,
    own_labels,
    proxy_fingerprint,
    proxy_name,
    read_own,
)
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings, make_plan_settings
from rosproxy_operator.proxy_spec.place import ZENOH
from tests.run_options import settings_of
from tests.unit.operator.docker.builders import (
    ENABLED,
    IMAGE,
    SECRET,
    SETTINGS,
    container,
    inspection,
    observed,
    planned,
)
from tests.unit.operator.docker.test_zenoh import PORTS, look, node, read

CLOUD = "tls/cloud.example:7447"
DIRECTORY = "/etc/rosproxy/link"
FILES = replace(SETTINGS, zenoh_link_certificates=DIRECTORY)
ALLOWED = replace(FILES, allow_link=("tls/*.example:7447",))
LABEL = "rosproxy.zenoh-link"


def options(*words: str) -> PlanSettings:
    """The settings for the words of a command line."""
    params = main.commands["docker"].make_context("docker", [*words]).params
    return make_plan_settings(params)


def test_what_the_options_say() -> None:
    settings = options(
        *("--zenoh-link", "tls/Cloud.example", "--zenoh-link", "quic/192.0.2.7:7448"),
        *("--zenoh-link-certificates", DIRECTORY, "--allow-link", "TLS/*.example"),
        *("--zenoh-limit", "/camera/image=2Hz", "--zenoh-link-policy", "deny publish /secret"),
    )
    assert settings.zenoh_link == (CLOUD, "quic/192.0.2.7:7448")
    assert settings.allow_link == ("tls/*.example:*",)
    assert list(map(str, settings.zenoh_limit)) == ["/camera/image=2Hz"]
    assert settings.link_rules == parse_rules("deny publish /secret")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--zenoh-link", "cloud"), "'cloud' is not of the form tls/HOST"),
        (("--zenoh-link", "tls/127.0.0.1"), "a loopback address, which means the proxy itself"),
        (("--zenoh-link", CLOUD), "--zenoh-link-certificates: missing"),
        (("--allow-link", "tls/*"), "--zenoh-link-certificates: missing"),
        (("--allow-link", "*"), "'*' is not of the form tls/HOST or tls/HOST:PORT"),
        (("--zenoh-link-certificates", "link"), "'link' is not a full path"),
        (("--zenoh-limit", "/a*b=2"), "--zenoh-limit: /a*b=2Hz: write *"),
        (("--zenoh-limit", "/camera"), "'/camera' is not of the form TOPIC=RATEHz"),
        (
            ("--zenoh-link-policy", "allow publish /a/b; deny publish /a/*"),
            "--zenoh-link-policy: layer '--zenoh-link-policy': ",
        ),
        (
            [f"--zenoh-link=tls/site-{n}" for n in range(MOST_ZENOH_LINKS + 1)]
            + ["--zenoh-link-certificates=/a"],
            "--zenoh-link: given 17 times",
        ),
    ],
)
def test_options_that_can_not_be(words: tuple[str, ...], text: str) -> None:
    with pytest.raises(Exception) as refused:  # noqa: PT011 - of click, or a SettingError
        options(*words)
    assert text in str(getattr(refused.value, "message", refused.value))


def test_a_label_chooses_among_allowed_links() -> None:
    labels = {LABEL: "tls/Cloud.example, tls/evil.test:7447 quic/cloud.example"}
    (member,), texts = read(node(labels=labels), settings=ALLOWED)
    assert member.links == {CLOUD}
    assert [text.partition(",")[0] for text in texts] == [
        f"label {LABEL} names 'tls/evil.test:7447'",
        f"label {LABEL} names 'quic/cloud.example:7447'",
    ]
    assert texts[0].endswith("start the operator with --allow-link tls/evil.test:7447")
    (member,), _ = read(node(labels=labels), settings=replace(FILES, zenoh_link=(CLOUD,)))
    assert member.links == {CLOUD}


def test_by_default_no_label_makes_a_link() -> None:
    (member,), (text,) = read(node(labels={LABEL: CLOUD}))
    assert not member.links
    assert text.endswith(f"--allow-link {CLOUD} --zenoh-link-certificates DIRECTORY")


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("/etc/shadow", f"label {LABEL}: '/etc/shadow' is not of the form tls/HOST"),
        (",".join(f"tls/h{n}" for n in range(17)), f"label {LABEL} names more than 16 hosts"),
    ],
)
def test_a_label_that_can_not_be(value: str, text: str) -> None:
    members, texts = read(node(labels={LABEL: value}), settings=ALLOWED)
    assert not members
    assert texts[0].startswith(text)


@pytest.mark.parametrize("ros", ["1", "2"])
def test_the_label_is_for_rmw_zenoh_alone(ros: str) -> None:
    labels = {**ENABLED, "rosproxy.ros": ros, "rosproxy.master-uri": "http://robot:11311"}
    plan = look(observed(container(labels={**labels, LABEL: CLOUD})), ALLOWED)
    texts = [problem.message for problem in plan.problems]
    assert any(text.startswith(f"label {LABEL} is ignored: the label is for") for text in texts)


def made(settings: PlanSettings, **labels: str) -> Create:
    plan = planned(observed(node(labels=labels)), settings, DockerMemory(), 100.0)
    actions = plan.actions + tuple(a for group in plan.deferred for a in group.actions)
    (action,) = (action for action in actions if isinstance(action, Create))
    return action


def test_the_proxy_gets_the_links_and_the_files() -> None:
    settings = replace(
        ALLOWED,
        zenoh_link=("tls/home:7447",),
        zenoh_limit=options("--zenoh-limit", "/camera/image=2Hz").zenoh_limit,
        zenoh_link_policy=(parse_rules("allow publish /status"), parse_rules("deny publish *")),
    )
    action = made(settings, **{LABEL: CLOUD})
    assert action.links == (CLOUD, "tls/home:7447")
    config = container_config(action, settings, SECRET, "")
    assert config["HostConfig"]["Mounts"] == [
        {"Type": "bind", "Source": DIRECTORY, "Target": "/etc/rosproxy/link", "ReadOnly": True}
    ]
    told = settings_of(dict(text.split("=", 1) for text in config["Env"]))
    assert list(map(str, told.zenoh_link)) == [CLOUD, "tls/home:7447"]
    assert told.zenoh_certificate == "/etc/rosproxy/link/tls.crt"
    assert list(map(str, told.zenoh_limit)) == ["/camera/image=2Hz"]
    assert told.link_policy[0].rules == settings.link_rules


def test_a_proxy_without_links_stays_as_before() -> None:
    """Also if the operator has the options, and no label asks for a link."""
    plain = Create("n", ZENOH, PORTS, "box")
    assert made(ALLOWED).links == ()
    assert container_config(plain, ALLOWED, SECRET, "") == container_config(
        plain, SETTINGS, SECRET, ""
    )
    linked = replace_links(plain)
    prints = {
        proxy_fingerprint(action, settings, IMAGE, SECRET)
        for action in (plain, linked)
        for settings in (ALLOWED, replace(ALLOWED, zenoh_link_certificates="/other"))
    }
    assert len(prints) == 3


def replace_links(action: Create) -> Create:
    return Create(action.name, action.place, action.range, action.sandbox, links=(CLOUD,))


def test_many_labels_leave_the_few_their_links() -> None:
    settings = replace(FILES, allow_link=("tls/*:*",), zenoh_link=("tls/home:7447",))
    crowd = [node(f"n{n}", {LABEL: " ".join(f"tls/h{n}-{m}" for m in range(10))}) for n in range(2)]
    few = node("few", {LABEL: "tls/few tls/home"})
    plan = look(observed(*crowd, few), settings)
    (desired,) = plan.desired
    assert len(desired.links) == 12
    assert {"tls/few:7447", "tls/home:7447"} <= {*desired.links}
    (problem,) = plan.problems
    assert problem.subject == "container n1"
    assert problem.message.startswith(f"label {LABEL} is ignored: a proxy has at most 16 links")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({}, ""),
        ({"Source": "/other"}, ""),  # another directory of the option, before the proxy goes
        ({"ReadOnly": False}, "HostConfig.Mounts is not the operator's"),
        ({"Target": "/"}, "HostConfig.Mounts is not the operator's"),
    ],
)
def test_the_proxy_is_known_with_its_files(change: dict[str, Any], reason: str) -> None:
    action = Create(proxy_name(ZENOH), ZENOH, PORTS, "box", links=(CLOUD,))
    body = container_config(action, FILES, SECRET, "")
    body["HostConfig"]["Mounts"][0] |= change
    own = read_own(own_labels(action))
    assert own
    assert forgery_reason(own, action.name, read_making(inspection(body)), IMAGE) == reason
