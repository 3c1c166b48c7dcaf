"""The files of links to other sites while the proxy runs: when they are read again."""

from pathlib import Path

import pytest

from rosproxy.shared.settings import Settings
from rosproxy.zenoh import site_links
from rosproxy.zenoh.link_files import LinkFiles, read_link_files
from rosproxy.zenoh.site_links import SiteLinks
from tests import certificates
from tests.certificates import CA, Authority
from tests.run_options import parse_settings


@pytest.fixture
def good(tmp_path: Path) -> Path:
    return Authority().write(tmp_path, "cloud.example")


@pytest.fixture
def links(good: Path) -> SiteLinks:
    given = {"ros": ("zenoh",), "zenoh_link": ("tls/cloud.example",), **certificates.options(good)}
    made = SiteLinks(parse_settings(given))
    made.check()
    return made


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """An entry for each time that the files were read."""
    made: list[bool] = []

    def count(settings: Settings) -> LinkFiles:
        made.append(True)
        return read_link_files(settings)

    monkeypatch.setattr(site_links, "read_link_files", count)
    return made


def errors(links: SiteLinks) -> list[str]:
    return [row.error for row in links.certificates() if row.error]


def test_a_fault_is_confirmed_once_and_then_waits_for_a_change(
    links: SiteLinks, good: Path, reads: list[bool]
) -> None:
    """To check a file of 1 MB, OpenSSL needs a second, in which the proxy would serve nothing."""
    right = (good / CA).read_bytes()
    (good / CA).write_bytes(b"no certificate")
    for _ in range(5):
        assert not links.look()
    assert len(reads) == 2
    assert "has no certificate as PEM" in errors(links)[0]
    (good / CA).write_bytes(right)
    assert not links.look(), "the contents are those from before"
    assert len(reads) == 3
    assert not errors(links)


def test_a_file_is_read_again_after_its_permissions_have_changed(
    links: SiteLinks, good: Path, reads: list[bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("builtins.open", _refuse)
        (good / CA).touch()
        for _ in range(3):
            assert not links.look()
    assert "can't be read" in errors(links)[0]
    (good / CA).chmod(0o644)
    links.look()
    assert not errors(links)


def test_a_missing_file_is_read_as_soon_as_it_is_back(links: SiteLinks, good: Path) -> None:
    right = (good / CA).read_bytes()
    (good / CA).unlink()
    for _ in range(3):
        assert not links.look()
    assert "can't be read: No such file" in errors(links)[0]
    (good / CA).write_bytes(right)
    links.look()
    assert not errors(links)


def _refuse(*args: object) -> object:
    raise PermissionError
