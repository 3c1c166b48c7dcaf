"""Pinned requirements: each with a version and hashes."""

import re

import pytest
from scripts.pins import ROOT, pins

EXTRAS = (
    *("uvloop", "zenoh", "docker", "kubernetes", "operator"),
    *("bench", "dev", "docs", "release", "build-system"),
)


def names(*extras: str) -> set[str]:
    return {pin.name for pin in pins(extras)}


def test_every_pin_is_a_version_with_hashes() -> None:
    every = pins(EXTRAS)
    assert len(every) > 50
    for pin in every:
        first, *hashes = pin.text.splitlines()
        assert re.match(r"[\w.-]+==[\w.]+( ; .+)? \\$", first), first
        assert hashes
        assert all(re.fullmatch(r"    --hash=sha256:[0-9a-f]{64}( \\)?", line) for line in hashes)


def test_images_are_built_on_what_a_digest_names() -> None:
    text = (ROOT / "Dockerfile").read_text()
    assert re.search(r"^ARG BASE_IMAGE=[\w.:/-]+@sha256:[0-9a-f]{64}$", text, re.M)
    stages = set(re.findall(r"^FROM \S+ AS (\S+)$", text, re.M))
    assert set(re.findall(r"^FROM (\S+)", text, re.M)) - stages == {"${BASE_IMAGE}"}


def test_every_pin_is_required() -> None:
    """Remove pins that are left over: make lock."""
    pinned = re.findall(r"^([\w.-]+)==", (ROOT / "constraints.txt").read_text(), re.M)
    assert len(pinned) == len(pins(EXTRAS))


def test_an_extra_brings_its_own_and_what_that_needs() -> None:
    assert {"aiohttp", "yarl", "propcache", "rich", "pygments"} <= names()
    assert not {"docker", "kopf", "pytest", "hatchling", "uvloop", "matplotlib"} & names()
    assert names("uvloop") - names() == {"uvloop"}
    assert {"docker", "requests", "urllib3"} <= names("docker")
    assert "kopf" not in names("docker")
    assert names("operator") == names("docker", "kubernetes")
    assert {"hatchling", "pathspec", "trove-classifiers"} <= names("build-system") - names()


def test_what_is_not_pinned_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scripts.pins._required", lambda _, extra: ["nothing-of-the-kind"])
    with pytest.raises(LookupError, match=r"nothing-of-the-kind\. Run make lock"):
        pins([])
