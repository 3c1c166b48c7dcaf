"""Copy the pages of the documentation to build/docs for MkDocs, at the same paths.

    python scripts/docs_site.py

If a link names a directory, GitHub shows the README.md of the directory. MkDocs needs the name of
the file, so the script writes this name into the link.
"""

import re
import shutil
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / "build/docs"
PAGE_PATTERNS = (
    *("*.md", "LICENSE", "docs", "examples/docker", "manifests"),
    *("charts/*/files/*", "charts/*/README.md"),
)
OMITTED_PREFIXES = (".github",)


def sources() -> list[Path]:
    """Return the files that become pages, and the files to which pages link."""
    words = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "--", *PAGE_PATTERNS]
    output = subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    return [Path(line) for line in output.splitlines() if not line.startswith(OMITTED_PREFIXES)]


def page(path: Path) -> str:
    """Return a page in which each link to a directory leads to the README.md of the directory."""

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
