"""A former state of the project: its chart and its images, from the history of git."""

import subprocess
from pathlib import Path

from tests.docker.engine import ROOT, build, run
from tests.docker.images import base_image
from tests.kubernetes.cluster.images import load_images

COMMIT = "d678ffc9f866e08e96ad90a332e841169eec3784"
TAG = "former"


def is_known() -> bool:
    """Whether the history has the former commit: a package or a shallow clone has not."""
    words = ["git", "-C", str(ROOT), "cat-file", "-e", f"{COMMIT}^{{commit}}"]
    return subprocess.run(words, capture_output=True, check=False).returncode == 0


def prepare(directory: Path) -> Path:
    """Build the former images, and load them into all nodes. Return the former chart."""
    archive = directory / "former.tar"
    run("git", "-C", ROOT, "archive", f"--output={archive}", COMMIT)
    source = directory / "former"
    source.mkdir()
    run("tar", "-x", "-f", archive, "-C", source)
    base = ("--build-arg", f"BASE_IMAGE={base_image()}")
    images = {"proxy": f"rosproxy:{TAG}", "operator": f"rosproxy-operator:{TAG}"}
    for target, image in images.items():
        build(image, *base, "--target", target, source)
    load_images(*images.values())
    return source / "charts/rosproxy-operator"
