"""The files of the page parse nothing that comes from nodes, and load nothing from elsewhere."""

from importlib.resources import files

FILES = files("rosproxy.page").joinpath("files")


def test_our_files_parse_nothing_that_comes_from_nodes() -> None:
    for name in ("page.js", "view.js", "picture.js", "findings.js", "history.js", "zoom.js"):
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
