"""Liveliness tokens: the parser reads those of rmw_zenoh, and ignores all other keys without
errors.
"""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.zenoh.protocol.liveliness import (
    LONGEST_TOKEN,
    MOST_TOKENS,
    Entity,
    EntityKind,
    Qos,
    TopicQos,
    ZenohNode,
    is_kept,
    nodes_of,
    parse_token,
    ros_type,
)
from rosproxy.zenoh.protocol.report import LONGEST_REPORT

ZID = "aac3178e146ba6f1fc6e6a4085e77f21"
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
STRING = "std_msgs::msg::dds_::String_"
NODE = f"@ros2_lv/0/{ZID}/0/0/NN/%/%/talker"
PUBLISHER = f"@ros2_lv/0/{ZID}/0/10/MP/%/%/talker/%chatter/{STRING}/{HASH}/::,10:,:,:,,"
NAME = st.from_regex(r"[a-z][a-z0-9_]{0,9}", fullmatch=True)
NAMES = st.lists(NAME, min_size=1, max_size=3).map(lambda parts: "/" + "/".join(parts))


def test_a_node_and_its_publisher() -> None:
    assert parse_token(NODE) == Entity(0, ZID, 0, EntityKind.NODE, "/talker")
    publisher = Entity(
        *(0, ZID, 0, EntityKind.PUBLISHER, "/talker", "/chatter", STRING, HASH, Qos(depth=10))
    )
    assert parse_token(PUBLISHER) == publisher
    assert publisher.node_key == f"0 {ZID}.0/talker"


@given(
    st.integers(0, 232),
    st.text("0123456789abcdef", min_size=1, max_size=32),
    st.sampled_from([kind for kind in EntityKind if kind is not EntityKind.NODE]),
    st.one_of(st.just(""), NAMES),
    NAME,
    NAMES,
)
def test_what_rmw_zenoh_writes_is_read(
    domain: int, session: str, kind: EntityKind, namespace: str, node: str, topic: str
) -> None:
    mangled = namespace.replace("/", "%") or "%"
    named = topic.replace("/", "%")
    key = (
        f"@ros2_lv/{domain}/{session}/3/4/{kind.value}/%/{mangled}/{node}/{named}/T_/H/::,1:,:,:,,"
    )
    entity = Entity(domain, session, 3, kind, f"{namespace}/{node}", topic, "T_", "H", Qos(depth=1))
    assert parse_token(key) == entity


@pytest.mark.parametrize(
    ("text", "qos"),
    [
        ("::,:,:,:,,", Qos()),
        ("::,10:,:,:,,", Qos(depth=10)),
        ("2:1:2,10", Qos("BEST_EFFORT", "TRANSIENT_LOCAL", "KEEP_ALL", 10)),
        ("1:2:1,7", Qos("RELIABLE", "VOLATILE", "KEEP_LAST", 7)),
        ("4:0:0,0", Qos("BEST_AVAILABLE", "SYSTEM_DEFAULT", "SYSTEM_DEFAULT", 0)),
        (":1:,", Qos(durability="TRANSIENT_LOCAL")),
        ("2", Qos("BEST_EFFORT")),
        ("x:9:7,y", Qos("UNKNOWN", "UNKNOWN", "UNKNOWN")),
        ("::,99999999999999999999", Qos()),
    ],
)
def test_the_qos_of_a_token(text: str, qos: Qos) -> None:
    entity = parse_token(PUBLISHER.replace("::,10:,:,:,,", text))
    assert entity is not None
    assert entity.qos == qos
    assert entity.is_transient_local is (qos.durability == "TRANSIENT_LOCAL")


@pytest.mark.parametrize(
    ("key_type", "ros"),
    [
        (STRING, "std_msgs/msg/String"),
        ("example_interfaces::srv::dds_::AddTwoInts_", "example_interfaces/srv/AddTwoInts"),
        ("custom", "custom"),
    ],
)
def test_a_type_in_a_key_has_a_ros_type(key_type: str, ros: str) -> None:
    assert ros_type(key_type) == ros


@given(st.one_of(st.text(), st.lists(st.text(max_size=8), min_size=8, max_size=14).map("/".join)))
def test_any_other_key_is_none(key: str) -> None:
    assert parse_token(key) is None


@given(st.integers(0, len(PUBLISHER)), st.text(max_size=3))
def test_a_changed_token_never_raises(place: int, text: str) -> None:
    entity = parse_token(PUBLISHER[:place] + text + PUBLISHER[place + 1 :])
    assert entity is None or entity.kind in EntityKind


@pytest.mark.parametrize(
    "key",
    [
        NODE.replace("/0/", "/x/", 1),
        NODE.replace("/0/", "/" + "9" * 5000 + "/", 1),
        NODE.replace(ZID, "x" * 32),
        NODE.replace("NN", "MP"),
        PUBLISHER.replace("MP", "NN"),
        PUBLISHER.replace("MP", "XX"),
        PUBLISHER.replace("%chatter", "x" * LONGEST_TOKEN),
        PUBLISHER.replace("%chatter", ""),
    ],
)
def test_what_is_no_token(key: str) -> None:
    assert parse_token(key) is None


def test_entities_become_nodes() -> None:
    keys = [NODE, PUBLISHER, PUBLISHER.replace("MP", "MS"), PUBLISHER.replace("MP", "SC")]
    keys += [
        PUBLISHER.replace("MP", "MS").replace(",10:", ",5:"),
        PUBLISHER.replace("/10/", "/11/"),
    ]
    keys.append(NODE.replace("/0/", "/5/", 1))
    entities = [entity for key in keys if (entity := parse_token(key))]
    assert nodes_of(reversed(entities)) == (
        ZenohNode(
            *(0, ZID, "/talker", ("/chatter",), ("/chatter",), (), ("/chatter",)),
            types=(("/chatter", "std_msgs/msg/String"),),
            qos=(
                TopicQos("/chatter", False, Qos(depth=5)),
                TopicQos("/chatter", False, Qos(depth=10)),
                TopicQos("/chatter", True, Qos(depth=10)),
            ),
        ),
        ZenohNode(5, ZID, "/talker", (), (), ()),
    )


@given(st.text(), st.characters())
def test_a_token_that_is_kept_is_short_in_json(key: str, letter: str) -> None:
    """A report with all tokens fits into its bound, with room for the sessions."""
    longest = f"{key}{letter}" + letter * (LONGEST_TOKEN - len(key) - 1)
    for token in (key, letter, longest):
        bytes_of_json = len(json.dumps(token)) + len(", ")
        assert not is_kept(token) or bytes_of_json * MOST_TOKENS < 0.6 * LONGEST_REPORT


@pytest.mark.parametrize("letter", ["\U0001f916", "\xe9", "\x01", '"', "\\", "\x7f", "\n"])
def test_a_letter_that_takes_several_bytes_in_json_is_of_no_token(letter: str) -> None:
    key = f"@ros2_lv/0/{ZID}/0/0/NN/%/%/talker"
    assert is_kept(key)
    assert not is_kept(key + letter)
    assert parse_token(key + letter) is None
