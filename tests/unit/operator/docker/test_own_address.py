"""Variables for a container's own address that keep its nodes from working."""

from dataclasses import replace

import pytest

from rosproxy_operator.docker.planner.labels.own_address import wrong_own_address
from rosproxy_operator.proxy_spec.place import Master, Place
from tests.unit.operator.docker.builders import (
    HERE,
    PLACE,
    ROBOT,
    container,
    observed,
    read_members,
)

TOWARDS = "198.51.100.7"
FAR = "203.0.113.9"


def wrong(place: Place = PLACE, **variables: str) -> str:
    seen = observed(advertise={"robot": TOWARDS}, default_route_address=FAR)
    return str(wrong_own_address(replace(container(), variables=variables), place, seen) or "")


@pytest.mark.parametrize("name", ["ROS_IP", "ROS_HOSTNAME"])
@pytest.mark.parametrize("value", ["127.0.0.1", "127.0.1.1", "localhost", " LOCALHOST ", "::1"])
def test_loopback(name: str, value: str) -> None:
    text = wrong(PLACE, **{name: value})
    assert "listen on loopback only" in text
    assert f"Unset {name}:" in text


def test_what_an_image_says_is_told_at_no_length() -> None:
    assert len(wrong(PLACE, ROS_HOSTNAME="x" * 100_000 + ".localhost")) < 300


@pytest.mark.parametrize("value", [HERE, TOWARDS, FAR, "172.18.0.1"])
def test_an_address_of_this_host(value: str) -> None:
    text = wrong(ROS_IP=value)
    assert f"ROS_IP={value} is the address of this host" in text
    assert "Unable to contact my own server" in text


def test_a_name_of_this_host() -> None:
    assert "is the address of this host" in wrong(
        Place(Master(ROBOT), "edge7"), ROS_HOSTNAME="Edge7"
    )


@pytest.mark.parametrize("value", ["", "172.18.0.3", "talker", "192.0.2.99"])
def test_what_does_no_harm(value: str) -> None:
    assert wrong(ROS_IP=value) == wrong(ROS_HOSTNAME=value) == wrong() == ""


def test_it_is_a_warning_of_the_container() -> None:
    _, (problem,) = read_members(observed(replace(container(), variables={"ROS_IP": HERE})))
    assert problem.subject == "container talker"
    assert not problem.fatal
