"""Text for terminals."""

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.shared.output.tables import besides_first, table
from rosproxy.shared.output.text import (
    brief,
    clean,
    duration,
    listed,
    plural,
    shorten,
    size,
    width,
    wrap,
)


@pytest.mark.parametrize(
    ("raw", "shown"),
    [
        ("/talker", "/talker"),
        ("/тест/節點", "/тест/節點"),
        ("\x1b[2J\x1b]0;owned\x07", "\\x1b[2J\\x1b]0;owned\\x07"),
        ("a\nb\rc\td", "a\\nb\\rc\\td"),
        ("\x9b31m", "\\x9b31m"),
        ("abc\u202etxt.exe", "abc\\u202etxt.exe"),
        ("zero\u200bwidth", "zero\\u200bwidth"),
        ("\udc80", "\\udc80"),
        ("del\x7f", "del\\x7f"),
        (42, "42"),
    ],
)
def test_clean_leaves_nothing_that_moves_the_cursor(raw: object, shown: str) -> None:
    assert clean(raw) == shown


@given(st.text())
def test_clean_text_is_printable(text: str) -> None:
    cleaned = clean(text)
    assert cleaned.isprintable()
    assert not any(unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp") for c in cleaned)


@pytest.mark.parametrize(
    ("text", "most", "shown"),
    [
        ("/talker", 7, "/talker"),
        ("/robot1/camera", 9, "/rob…mera"),
        ("a\nb", 4, "a\\nb"),
        ("a\nb", 3, "a…b"),
        ("abc", 1, "…"),
    ],
)
def test_brief_is_clean_and_keeps_both_ends(text: str, most: int, shown: str) -> None:
    assert brief(text, most) == shown


@given(st.text(), st.integers(1, 40))
def test_brief_text_fits(text: str, most: int) -> None:
    shown = brief(text, most)
    assert len(shown) <= most
    assert shown.isprintable()
    assert brief(shown, most) == shown


@pytest.mark.parametrize(
    ("text", "columns"), [("", 0), ("abc", 3), ("節點", 4), ("e\u0301", 1), ("/\uff46", 3)]
)
def test_width(text: str, columns: int) -> None:
    assert width(text) == columns


@pytest.mark.parametrize(
    ("text", "most", "shown"),
    [
        ("/talker", 7, "/talker"),
        ("/robot1/camera/driver", 11, "/robo…river"),
        ("節點節點節點", 7, "節點…點"),
        ("abc", 1, "…"),
        ("abc", 0, "…"),
    ],
)
def test_shorten_keeps_both_ends(text: str, most: int, shown: str) -> None:
    assert shorten(text, most) == shown


@given(st.text(), st.integers(1, 40))
def test_shortened_text_fits(text: str, most: int) -> None:
    cleaned = clean(text)
    shown = shorten(cleaned, most)
    assert width(shown) <= most


def test_wrap_keeps_words_whole_and_bounds_lines() -> None:
    lines = wrap("publish the range: docker run -p 45000-45099:45000-45099", 24, "  ", "> ")
    assert lines == ["> publish the range:", "  docker run -p", "  45000-45099:45000-45099"]
    assert wrap("one two three four five six seven", 22, "", most=1) == ["one two three four …"]


def test_table_shortens_the_first_cell_only() -> None:
    rows = [("NODE", "AT", "N"), ("/a_long_name", "here", "1"), ("/b", "節點", "12")]
    assert besides_first(rows) == 10
    assert table(rows, 2, 6) == [
        "NODE    AT     N",
        "/a_…me  here   1",
        "/b      節點  12",
    ]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (-1, "0.0 s"),
        (0.42, "0.4 s"),
        (12.3, "12 s"),
        (60, "1 min"),
        (185, "3 min"),
        (7500, "2 h 5 min"),
        (7200, "2 h"),
        (200_000, "2 d 7 h"),
    ],
)
def test_duration(seconds: float, text: str) -> None:
    assert duration(seconds) == text


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 B"),
        (812.4, "812 B"),
        (999.6, "1.0 kB"),
        (1500, "1.5 kB"),
        (123_456, "123 kB"),
        (2.5e12, "2.5 TB"),
        (9e15, "9000 TB"),
    ],
)
def test_size(count: float, text: str) -> None:
    assert size(count) == text


def test_lists_and_plurals() -> None:
    assert listed([]) == ""
    assert listed("abc") == "a, b, c"
    assert listed("abcdef", 2) == "a, b and 4 more"
    assert plural(1, "port") == "1 port"
    assert plural(0, "port") == "0 ports"
    assert plural(2, "address") == "2 addresses"
    assert plural(2, "proxy") == "2 proxies"
    assert plural(2, "key") == "2 keys"
