"""The files of the page: what others made is as they made it, and named with its licence."""

import hashlib
from importlib.resources import files
from pathlib import Path

FILES = files("rosproxy.page").joinpath("files")
GUIDE = Path(__file__).parents[3] / "docs/guide/live-page.md"
VERSION = "3.34.4"
SHA256 = "081591ab735b2b6a3b31a3c60f8f3a3e2fee8c92939e0c7820ad1208571b6cd8"
"""Of dist/cytoscape.min.js in cytoscape-3.34.4.tgz of the npm registry."""


def test_cytoscape_is_what_was_published() -> None:
    body = FILES.joinpath("cytoscape.min.js").read_bytes()
    assert hashlib.sha256(body).hexdigest() == SHA256
    assert f'"{VERSION}"'.encode() in body
    assert VERSION in GUIDE.read_text()
    assert "The Cytoscape Consortium" in FILES.joinpath("cytoscape.LICENSE").read_text()


def test_our_own_files_parse_nothing_that_comes_from_nodes() -> None:
    for name in ("page.js", "view.js"):
        text = FILES.joinpath(name).read_text()
        for way in (
            "innerHTML",
            "outerHTML",
            "insertAdjacentHTML",
            "document.write",
            "eval(",
            "://",
        ):
            assert way not in text, f"{name}: {way}"
