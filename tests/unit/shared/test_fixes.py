"""The fixes of findings: each speaks the words of the program that has started the proxy."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import rosproxy
from rosproxy.shared import fixes
from rosproxy.shared.fixes import FIXES, Fix, how_to, how_to_in_a_sentence
from rosproxy.shared.setting_kinds import declared
from rosproxy.shared.settings import Settings

FIELDS = dict.fromkeys(("ports", "published", "uri", "host", "port", "nodes", "domain"), "x")
OPTIONS = [setting.name for setting in declared(Settings)]
SOURCES = (
    *("doctor/rules/*.py", "shared/documents/setup_rules.py", "shared/connections/gate.py"),
    *("ros2/domain_problems.py", "zenoh/findings.py", "forwarding/kernel/*.py"),
)


@pytest.fixture
def in_a_cluster() -> Iterator[None]:
    fixes.speak_for("kubernetes")
    yield
    fixes.speak_for("")


@pytest.mark.parametrize("fix", FIXES.values(), ids=FIXES)
def test_no_fix_speaks_of_another_engine(fix: Fix) -> None:
    assert not re.search(r"docker|compose", fix.kubernetes, re.IGNORECASE)
    assert not [option for option in OPTIONS if re.search(rf" {option}\b", fix.kubernetes)]
    assert not re.search(r"kubectl|pod\b|spec\.", fix.docker, re.IGNORECASE)
    assert not re.search(r"kubectl|pod\b|spec\.|rosproxy\.\w+=", fix.by_hand, re.IGNORECASE)


@pytest.mark.parametrize("fix", FIXES.values(), ids=FIXES)
def test_a_fix_is_an_imperative_that_goes_on(fix: Fix) -> None:
    for text in fix:
        assert text.format(**FIELDS)[0].islower() or text.startswith("rootless Docker")
        assert not text.endswith(".")


@pytest.mark.parametrize("pattern", SOURCES)
def test_rules_take_all_such_words_from_the_table(pattern: str) -> None:
    paths = [*Path(rosproxy.__file__).parent.glob(pattern)]
    assert paths
    for path in paths:
        code = path.read_text(encoding="utf-8")
        code = re.sub(r'(?s:""".*?""")|#.*', "", code)
        assert not re.search(r"docker (run|exec|ps)|kubectl", code), path
        assert not [option for option in OPTIONS if re.search(rf"{option}\b", code)], path


def test_a_proxy_speaks_for_its_operator(in_a_cluster: None) -> None:
    assert how_to("larger range") == "set a larger spec.ports"
    assert how_to_in_a_sentence("larger range") == "Set a larger spec.ports"
    fixes.speak_for("docker")
    assert "label rosproxy.ports=N" in how_to("larger range")
    for unknown in ("", "of a later release", "none"):
        fixes.speak_for(unknown)
        assert "--port-range" in how_to("larger range")
