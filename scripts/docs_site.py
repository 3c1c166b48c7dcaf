"""Lay out the pages of the documentation for MkDocs, as they lie in the repository.

    python scripts/docs_site.py        writes build/docs

GitHub shows a directory's README.md where a link names the directory; MkDocs wants the file.
"""

import re
import shutil
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / "build/docs"
SHOWN = (
    *("*.md", "LICENSE", "docs", "examples/docker", "manifests"),
    *("charts/*/files/*", "charts/*/README.md"),
)
HIDDEN = (".github",)


def sources() -> list[Path]:
    """The files that pages are made of or link to."""
    words = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "--", *SHOWN]
    said = subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    return [Path(line) for line in said.splitlines() if not line.startswith(HIDDEN)]


def page(path: Path) -> str:
    """A page in which links to directories lead to their README.md."""

    def link(match: re.Match[str]) -> str:
        directory = ROOT / path.parent / match[1]
        return f"]({match[1]}/README.md)" if (directory / "README.md").exists() else match[0]

    return re.sub(r"\]\(([^)#:\s]+)\)", link, (ROOT / path).read_text())


def main() -> None:
    shutil.rmtree(TARGET, ignore_errors=True)
    for path in sources():
        target = TARGET / path
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".md":
            target.write_text(page(path))
        else:
            shutil.copy(ROOT / path, target)


if __name__ == "__main__":
    main()
