"""How the project writes (CONTRIBUTING.md, Style): what a machine can tell."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROOTS = ("proxy", "operator", "examples", "scripts", "tests", "charts", "docs")
RIDDLES = re.compile(
    r"\b(?:somebody|nobody|anybody|everybody|whoever|whom)\b"
    r"|\b(?:of|to|by|for|from|that|and|where|if) who\b|, who\b"
    r"|(?:^|[.;:]\s+)Who\b(?![^.]*\?)",
    re.IGNORECASE,
)
"""Pronouns in the place of the noun that a reader looks for."""
PARTS_OF_RIDDLES = re.compile("who|body", re.IGNORECASE)
"""Every riddle has one of these. Sources without are not parsed."""
CODE_IN_TEXT = re.compile(r"`[^`]*`")


def python_files() -> list[Path]:
    """All sources of the project in Python."""
    found = (path for root in ROOTS for path in (ROOT / root).rglob("*.py"))
    return sorted(path for path in found if not {"build", ".venv"} & set(path.parts))


def pages() -> list[Path]:
    """All pages of the project."""
    found = (path for root in ROOTS for path in (ROOT / root).rglob("*.md"))
    return sorted([*ROOT.glob("*.md"), *found])


def texts_of_python(source: str) -> Iterator[tuple[int, str]]:
    """The docstrings, comments and other texts of a source, each with its line."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.lineno, node.value
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("#: ")


def texts_of_page(page: str) -> Iterator[tuple[int, str]]:
    """The lines of a page that are no code, each with its number."""
    is_code = False
    for number, line in enumerate(page.splitlines(), 1):
        if line.lstrip().startswith("```"):
            is_code = not is_code
        elif not is_code:
            yield number, line


def riddles(path: Path) -> list[str]:
    """The sentences of a file that hide their noun, each with its place."""
    source = path.read_text()
    if not PARTS_OF_RIDDLES.search(source):
        return []
    texts = texts_of_python(source) if path.suffix == ".py" else texts_of_page(source)
    name = path.relative_to(ROOT)
    return [
        f"{name}:{line}: {match[0].strip()!r}"
        for line, text in texts
        for match in RIDDLES.finditer(CODE_IN_TEXT.sub("code", text))
    ]


def test_texts_name_what_they_speak_of() -> None:
    own = Path(__file__).resolve()  # it has examples of riddles
    files = [path for path in (*python_files(), *pages()) if path != own]
    # Name the node, the container, the caller or the reader instead.
    assert not [riddle for path in files for riddle in riddles(path)]


@pytest.mark.parametrize(
    ("text", "is_riddle"),
    [
        ("The port goes to whoever asks first.", True),
        ("Who asks first gets the port.", True),
        ("Who asks?", False),
        ("A user who labels a container gets a proxy.", False),
        ("The proxy answers those who ask, and who wait.", True),
        ("Docker runs as `nobody`.", False),
    ],
)
def test_what_counts_as_a_riddle(text: str, is_riddle: bool) -> None:
    assert bool(RIDDLES.search(CODE_IN_TEXT.sub("code", text))) is is_riddle


def golf(source: str) -> list[int]:
    """The lines of a source that give several names their values, and neither swap nor unpack."""
    return [
        node.lineno
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Tuple)
        and isinstance(node.value, ast.Tuple)
        and {*map(ast.unparse, node.targets[0].elts)} != {*map(ast.unparse, node.value.elts)}
    ]


def test_one_name_gets_its_value_in_a_line() -> None:
    assert not [
        f"{path.relative_to(ROOT)}:{line}"
        for path in python_files()
        for line in golf(path.read_text())
    ]


@pytest.mark.parametrize(
    ("source", "lines"),
    [("a, b = 1, 2", [1]), ("a, b = b, a", []), ("a, b = call()", []), ("a = b = 1", [])],
)
def test_what_counts_as_several(source: str, lines: list[int]) -> None:
    assert golf(source) == lines
