"""Requests to the admin endpoint: accepted bodies, and errors that name the field."""

import json
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.shared.documents.requests import (
    ArrivedContainer,
    BodyError,
    ContainerUpdate,
    EmptyBody,
    MasterAddress,
    read_body,
)

GOOD: list[tuple[Any, ContainerUpdate]] = [
    ({}, ContainerUpdate()),
    ({"gone": []}, ContainerUpdate()),
    ({"gone": ["172.18.0.5", "fd00::5"]}, ContainerUpdate(gone=("172.18.0.5", "fd00::5"))),
    ({"gone": ["::ffff:172.18.0.5"]}, ContainerUpdate(gone=("172.18.0.5",))),
    ({"moved": {"172.18.0.5": "172.18.0.9"}}, ContainerUpdate(moved={"172.18.0.5": "172.18.0.9"})),
    (
        {"arrived": [{"address": "172.18.0.7", "names": ["Talker", "3f2a91c0b7de", "a.b-c_d"]}]},
        ContainerUpdate(
            arrived=(
                ArrivedContainer("172.18.0.7", frozenset({"talker", "3f2a91c0b7de", "a.b-c_d"})),
            )
        ),
    ),
    (
        {"arrived": [{"address": "172.18.0.7"}]},
        ContainerUpdate(arrived=(ArrivedContainer("172.18.0.7"),)),
    ),
    ({"selected": []}, ContainerUpdate(selected=())),
    ({"selected": ["::ffff:172.18.0.5"]}, ContainerUpdate(selected=("172.18.0.5",))),
]


@pytest.mark.parametrize(("body", "update"), GOOD)
def test_update(body: Any, update: ContainerUpdate) -> None:
    assert read_body(body, ContainerUpdate) == update


BAD: list[tuple[Any, str]] = [
    (None, "the body: Expected `object`, got `null`"),
    ([], "the body: Expected `object`, got `array`"),
    ("gone", "the body: Expected `object`, got `str`"),
    (1, "the body: Expected `object`, got `int`"),
    (True, "the body: Expected `object`, got `bool`"),
    ({"goen": []}, "the body: Object contains unknown field `goen`; known: gone, moved, arrived"),
    ({"selected": "172.18.0.5"}, "selected: Expected `array"),
    ({"selected": ["10.0.0.0/24"]}, "selected[0]: must be an IP address such as 172.18.0.5"),
    ({"gone": "172.18.0.5"}, "gone: Expected `array`, got `str`"),
    ({"gone": {}}, "gone: Expected `array`, got `object`"),
    ({"gone": ["a"]}, "gone[0]: must be an IP address such as 172.18.0.5, not 'a'"),
    ({"gone": ["10.0.0.1", 1]}, "gone[1]: Expected `str`, got `int`"),
    ({"gone": ["0.0.0.0"]}, "gone[0]: must be"),
    ({"gone": ["224.0.0.1"]}, "gone[0]: must be"),
    ({"gone": ["fe80::1%eth0"]}, "gone[0]: must be"),
    ({"gone": ["10.0.0.0/24"]}, "gone[0]: must be"),
    ({"moved": []}, "moved: Expected `object`, got `array`"),
    ({"moved": {"c1": "10.0.0.1"}}, "moved: must be an IP address such as 172.18.0.5, not 'c1'"),
    ({"moved": {"10.0.0.1": "c1"}}, "moved['10.0.0.1']: must be an IP address"),
    ({"moved": {"10.0.0.1": None}}, "moved[...]: Expected `str`, got `null`"),
    ({"arrived": [{"address": "x"}]}, "arrived[0].address: must be an IP address such as"),
    ({"arrived": {}}, "arrived: Expected `array`, got `object`"),
    ({"arrived": ["10.0.0.1"]}, "arrived[0]: Expected `object`, got `str`"),
    ({"arrived": [{}]}, "arrived[0]: Object missing required field `address`"),
    (
        {"arrived": [{"address": "10.0.0.1", "name": "x"}]},
        "arrived[0]: Object contains unknown field `name`",
    ),
    (
        {"arrived": [{"address": "10.0.0.1", "names": "x"}]},
        "arrived[0].names: Expected `array`, got `str`",
    ),
    (
        {"arrived": [{"address": "10.0.0.1", "names": ["x", "/y"]}]},
        "arrived[0].names: must be host names, not '/y'",
    ),
    ({"arrived": [{"address": "10.0.0.1", "names": [""]}]}, "arrived[0].names: must be"),
    ({"arrived": [{"address": "10.0.0.1", "names": [7]}]}, "arrived[0].names[0]: Expected `str`"),
]


@pytest.mark.parametrize(("body", "complaint"), BAD)
def test_a_mistake_names_its_field(body: Any, complaint: str) -> None:
    with pytest.raises(BodyError) as caught:
        read_body(body, ContainerUpdate)
    assert str(caught.value).startswith(complaint)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)
FIELDS = st.sampled_from(["gone", "moved", "arrived", "address", "names"])


def complaint_of(kind: type[msgspec.Struct], body: Any) -> str:
    try:
        read_body(body, kind)
    except BodyError as error:
        return str(error)
    return ""


@given(st.dictionaries(FIELDS, JSON) | JSON)
def test_anything_else_is_a_mistake_in_one_short_line(body: Any) -> None:
    for kind in (ContainerUpdate, MasterAddress, EmptyBody):
        complaint = complaint_of(kind, json.loads(json.dumps(body)))
        assert "\n" not in complaint
        assert len(complaint) < 200


def test_a_master_address() -> None:
    assert read_body({"address": "192.0.2.7"}, MasterAddress).address == "192.0.2.7"


@pytest.mark.parametrize("body", [{}, {"address": "robot"}, {"address": None}, [], {"adress": "x"}])
def test_a_bad_master_address(body: Any) -> None:
    with pytest.raises(BodyError, match=r"address|the body"):
        read_body(body, MasterAddress)


def test_no_body() -> None:
    read_body({}, EmptyBody)
    with pytest.raises(BodyError, match="unknown field `x`; known: none"):
        read_body({"x": 1}, EmptyBody)
