"""Build all parts of a release into dist/, and try each part like a user.

    python scripts/release_check.py              Check the working tree, as `make release-check`.
    python scripts/release_check.py --tag v1.2.3 Check the release with the tag.
    … --registry ghcr.io/me                      Put this registry into chart and manifest.
    … --repository https://github.com/me/rosproxy    Put links there into chart and alerts.
    … --only packages                            Run some steps only.

The steps:

  - versions: The version is the same everywhere.
  - packages: The wheel and sdist are reproducible. The packages install without the sources.
  - sbom: The list (CycloneDX) has the installed packages.
  - chart: The script lints and packs the chart.
  - images: The script builds the images, and asks each image for the version.
  - registry: The script pushes images and chart to a registry on this machine, and pulls both.

A step that cannot run fails. The script publishes nothing.
"""

import argparse
import hashlib
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import tarfile
import tempfile
import time
import urllib.request
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from scripts.pins import pins  # noqa: E402

DIST = ROOT / "dist"
CHART = ROOT / "charts/rosproxy-operator"
BIN = Path(sys.executable).parent
PROGRAMS = {"rosproxy": "", "rosproxy-operator": "operator"}
"""The installed programs, each with the required extra of the wheel."""
SETTINGS = ("--master-uri", "http://127.0.0.1:11311", "--advertise-host", "127.0.0.1")


class ReleaseFault(Exception):
    """A part of the release is not right. The text says which part, and what to do."""


@dataclass(frozen=True)
class Release:
    """A release. ``tag`` is the git tag, or empty; ``base_image`` the base of the images.

    ``registry`` is the prefix of the images' names in chart and manifest. ``repository`` is the URL
    for links in chart and alerts. Either may be empty.
    """

    version: str
    tag: str
    base_image: str
    registry: str
    repository: str

    @property
    def runbook(self) -> str:
        """The URL or path of the page about alerts."""
        at = f"{self.repository}/blob/v{self.version}/" if self.repository else ""
        return f"{at}docs/guide/alerts.md"

    def image(self, program: str) -> str:
        """The whole name of an image."""
        return f"{self.registry}/{program}:{self.version}".lstrip("/")


def run(*command: str | Path, **more: str) -> str:
    """Run a program and return the output. If it fails, raises ReleaseFault with the output."""
    done = subprocess.run(
        [str(argument) for argument in command], cwd=ROOT, env={**os.environ, **more}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False,
    )  # fmt: skip
    if done.returncode:
        raise ReleaseFault(f"{' '.join(map(str, command))}: exit {done.returncode}\n{done.stdout}")
    return done.stdout


def project_version() -> str:
    """The version in the code."""
    text = (ROOT / "proxy/rosproxy/__init__.py").read_text()
    match = re.search(r'^__version__ = "(\d+\.\d+\.\d+)"$', text, re.M)
    if match is None:
        raise ReleaseFault("proxy/rosproxy/__init__.py has no __version__ of three numbers")
    return match[1]


# == versions ======================================================================================


def check_versions(release: Release) -> None:
    """Check that all files have the same version, and with a tag also the tag and the changelog."""
    chart = yaml.safe_load((CHART / "Chart.yaml").read_text())
    versions = {
        "Chart.yaml, version": chart["version"],
        "Chart.yaml, appVersion": chart["appVersion"],
    }
    manifest = (ROOT / "manifests/install.yaml").read_text()
    images = re.findall(r"\b(rosproxy(?:-operator)?):([\w.+-]+)\"?$", manifest, re.M)
    labels = set(re.findall(r"app\.kubernetes\.io/version: \"(.*)\"", manifest))
    versions |= {f"manifests/install.yaml, image {name}": tag for name, tag in images}
    versions["manifests/install.yaml, labels"] = " ".join(sorted(labels))
    if len(versions) != 5:
        raise ReleaseFault(f"manifests/install.yaml has not both images: {sorted(versions)}")
    if release.tag:
        versions["tag"] = release.tag.removeprefix("v")
        versions["CHANGELOG.md, newest heading"] = newest(ROOT / "CHANGELOG.md")
    differing = {
        source: version for source, version in versions.items() if version != release.version
    }
    if differing:
        text = f"the code has {release.version}, and others another version: {differing}"
        raise ReleaseFault(f"{text}; docs/releasing.md lists the places to change")


def newest(changelog: Path) -> str:
    """Return the version of the newest entry. Raises ReleaseFault if changes are unreleased."""
    headings = re.findall(r"^## \[(.*?)\](?: - \d{4}-\d{2}-\d{2})?$", changelog.read_text(), re.M)
    unreleased = changelog.read_text().partition("## [Unreleased]")[2].partition("\n## ")[0]
    if unreleased.strip():
        raise ReleaseFault(
            "CHANGELOG.md has changes under [Unreleased]: give them the version's heading"
        )
    return next((heading for heading in headings if heading != "Unreleased"), "none")


# == packages ======================================================================================


def check_packages(release: Release) -> None:
    """Build wheel and sdist twice, compare the builds, and install the wheel."""
    for path in DIST.glob("rosproxy-*"):
        path.unlink()
    with tempfile.TemporaryDirectory() as again:
        for target in (DIST, Path(again)):
            run(BIN / "python", "-m", "build", "--no-isolation", "--outdir", target, ROOT)
        built = sorted(path.name for path in DIST.glob("rosproxy-*"))
        expected = [f"rosproxy-{release.version}-py3-none-any.whl",
                    f"rosproxy-{release.version}.tar.gz"]  # fmt: skip
        if built != expected:
            raise ReleaseFault(f"dist has {built}, and not {expected}")
        differing = [name for name in built if digest(DIST / name) != digest(Path(again) / name)]
        if differing:
            raise ReleaseFault(f"built twice, these differ: {differing}")
    wheel, sdist = (DIST / name for name in expected)
    check_contents(wheel, sdist)
    # `python -m build` makes the wheel from the sdist, so testing the wheel suffices.
    for program, extra in PROGRAMS.items():
        environment = install(wheel, extra)
        for words in (("--version",), ("--help",)):
            said = run(environment / "bin" / program, *words)
            if words == ("--version",) and release.version not in said:
                raise ReleaseFault(f"{program} of {wheel.name} has version {said}")
    run(ROOT / "build/release/rosproxy/bin/rosproxy", "run", "--check", *SETTINGS)


def check_contents(wheel: Path, sdist: Path) -> None:
    """Check for required and unwanted files."""
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    scripts = ("page.js", "view.js", "picture.js", "findings.js", "history.js", "zoom.js")
    needed = {"rosproxy/py.typed", "rosproxy_operator/py.typed", "rosproxy/cli/main.py"}
    page = (*scripts, "page.css", "index.html", "login.html")
    needed |= {f"rosproxy/page/files/{name}" for name in page}
    tops = {name.partition("/")[0].partition("-")[0] for name in names}
    if not needed <= names or tops != {"rosproxy", "rosproxy_operator"}:
        raise ReleaseFault(f"{wheel.name} has {sorted(tops)}, and lacks {sorted(needed - names)}")
    if not [name for name in names if name.endswith("licenses/LICENSE")]:
        raise ReleaseFault(f"{wheel.name} has no LICENSE")
    with tarfile.open(sdist) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    lacking = {"LICENSE", "README.md", "pyproject.toml", "proxy/rosproxy/py.typed"} - inside
    extra = [name for name in inside if name.startswith((".venv", "build/", "dist/", ".git/"))]
    if lacking or extra:
        raise ReleaseFault(
            f"{sdist.name} lacks {sorted(lacking)}, and has {sorted(extra)[:5]} besides"
        )


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def install(wheel: Path, extra: str) -> Path:
    """Make a new environment with the wheel and the pinned requirements only. Return its path."""
    target = ROOT / "build/release" / ("rosproxy-operator" if extra else "rosproxy")
    shutil.rmtree(target, ignore_errors=True)
    run(BIN / "python", "-m", "venv", "--without-pip", target)
    pinned = target / "pins.txt"
    pinned.write_text("\n".join(pin.text for pin in pins([extra] if extra else [])) + "\n")
    pip = (BIN / "python", "-m", "pip", "--disable-pip-version-check", "--quiet",
           "--python", target / "bin/python", "install")  # fmt: skip
    run(*pip, "--only-binary", ":all:", "--require-hashes", "--requirement", pinned)
    run(*pip, "--no-deps", wheel)
    return target


# == SBOM, chart, images ===========================================================================


def check_sbom(release: Release) -> None:
    """Write an SBOM for each program, and check for all installed packages."""
    for program in PROGRAMS:
        python = ROOT / "build/release" / program / "bin/python"
        if not python.exists():
            raise ReleaseFault(f"{python} is not there: run the step packages first")
        path = DIST / f"{program}-{release.version}.cdx.json"
        options = ("--pyproject", "pyproject.toml", "--output-reproducible", "--validate")
        run(BIN / "cyclonedx-py", "environment", *options, "-o", path, python)
        listed = {
            component["name"].lower() for component in json.loads(path.read_text())["components"]
        }
        lines = run(BIN / "python", "-m", "pip", "--python", python, "freeze", "--all")
        installed = {line.partition("==")[0].lower() for line in lines.splitlines() if "==" in line}
        if len(installed) < 10 or installed - listed:
            raise ReleaseFault(f"{path.name} lacks {sorted(installed - listed)}")
        print(f"  {path.name}: {len(listed)} components")


def check_chart(release: Release) -> None:
    """Lint and pack the chart. Check that chart and manifest pull the right images."""
    helm = shutil.which("helm") or cluster_program("helm")
    with tempfile.TemporaryDirectory() as directory:
        chart = Path(directory) / CHART.name
        shutil.copytree(CHART, chart)
        adapt(chart, release)
        run(helm, "lint", "--strict", "--kube-version", "1.30.0", chart)
        run(helm, "package", chart, "--destination", DIST)
        for name in ("alerts.yaml", "dashboard.json"):
            shutil.copy(chart / "files" / name, DIST)
    package = DIST / f"rosproxy-operator-{release.version}.tgz"
    with tarfile.open(package) as archive:
        if f"{CHART.name}/LICENSE" not in archive.getnames():
            raise ReleaseFault(f"{package.name} has no LICENSE")
    rules = ("--set", "prometheusRule.enabled=true")
    made = run(helm, "template", "r", package, "--kube-version", "1.30.0", *rules)
    text = (ROOT / "manifests/install.yaml").read_text()
    named = rf"\b(rosproxy(?:-operator)?:{re.escape(release.version)})(?=\"?$)"
    manifest = re.sub(named, rf"{release.registry}/\1".lstrip("/"), text, flags=re.M)
    (DIST / "install.yaml").write_text(manifest)
    for file_name, objects in ((package.name, made), ("install.yaml", manifest)):
        for image in (f'image: "{release.image("rosproxy-operator")}"',
                      f"--proxy-image={release.image('rosproxy')}"):  # fmt: skip
            if f"{image}\n" not in objects:
                raise ReleaseFault(f"{file_name} does not pull {image}")
    alerts = (DIST / "alerts.yaml").read_text()
    if f"runbook_url: {release.runbook}#" not in made or release.runbook not in alerts:
        raise ReleaseFault(f"the alerts of {package.name} do not link to {release.runbook}")


def adapt(chart: Path, release: Release) -> None:
    """Write images, links, licence and changes into a chart."""
    shutil.copy(ROOT / "LICENSE", chart)
    alerts = chart / "files/alerts.yaml"
    link = "runbook_url: docs/guide/alerts.md"
    alerts.write_text(alerts.read_text().replace(link, f"runbook_url: {release.runbook}"))
    values = chart / "values.yaml"
    about = chart / "Chart.yaml"
    text = values.read_text()
    if release.registry:
        to = rf"\1{release.registry}/\2"
        text = re.sub(r"(?m)^( +repository: )(rosproxy.*)$", to, text)
    described = describe(yaml.safe_load(about.read_text()), release)
    about.write_text(yaml.safe_dump(described, sort_keys=False, allow_unicode=True))
    values.write_text(text)


def describe(about: dict[str, Any], release: Release) -> dict[str, Any]:
    """Chart.yaml with links, icon, and annotations for Artifact Hub.

    ``artifacthub.io/signKey`` is not necessary: Artifact Hub finds keyless signatures.
    """
    images = [{"name": program, "image": release.image(program)} for program in PROGRAMS]
    changes = chart_changes((ROOT / "CHANGELOG.md").read_text(), release.version)
    annotations = {
        **about["annotations"],
        "artifacthub.io/images": yaml.safe_dump(images, sort_keys=False),
        "artifacthub.io/changes": yaml.safe_dump(changes, allow_unicode=True, width=1000),
    }
    links: dict[str, Any] = {}
    if release.repository:
        links = {
            "home": release.repository,
            "sources": [release.repository],
            "icon": f"{release.repository}/raw/v{release.version}/docs/icon.svg",
        }
    return {**about, **links, "annotations": annotations}


def chart_changes(changelog: str, version: str) -> list[str]:
    """The changes of a version under the heading Kubernetes, without Markdown links."""
    entry = changelog.partition(f"## [{version}]")[2].partition("\n## ")[0]
    section = entry.partition("### Kubernetes\n")[2].partition("\n### ")[0]
    items = re.findall(r"^- (.*(?:\n  .*)*)", section, re.M)
    plain = (re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", item) for item in items)
    return [" ".join(item.split()) for item in plain]


def cluster_program(name: str) -> Path:
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    path = Path(os.environ.get("CLUSTER_BIN") or Path(cache) / "rosproxy/cluster") / name
    if not path.exists():
        raise ReleaseFault(f"{name} is not here: scripts/install-kubernetes.sh builds it")
    return path


def check_images(release: Release) -> None:
    """Build both images, and check the versions."""
    versions = {
        "TAG": release.version,
        "REGISTRY": release.registry,
        "BASE_IMAGE": release.base_image,
    }
    run("make", "image", *(f"{name}={value}" for name, value in versions.items()))
    for program in PROGRAMS:
        image = release.image(program)
        said = run("docker", "run", "--rm", "--network", "none", image, "--version")
        if release.version not in said:
            raise ReleaseFault(f"the image {image} has version {said}")
        size = int(run("docker", "image", "inspect", "--format", "{{.Size}}", image))
        print(f"  {image}: {size / 1e6:.0f} MB")


# == registry ======================================================================================


def check_registry(release: Release) -> None:
    """Check that both images, and the chart by oci://, are the same after push and pull."""
    with tempfile.TemporaryDirectory() as directory, running_registry(Path(directory)) as address:
        for program in PROGRAMS:
            check_pulled(release.image(program), f"{address}/{program}:{release.version}")
        helm = shutil.which("helm") or cluster_program("helm")
        package = DIST / f"rosproxy-operator-{release.version}.tgz"
        run(helm, "push", package, f"oci://{address}/charts", "--plain-http")
        wanted = (f"oci://{address}/charts/rosproxy-operator", "--version", release.version)
        pulled = run(helm, "template", "r", *wanted, "--plain-http", "--kube-version", "1.30.0")
        made = run(helm, "template", "r", package, "--kube-version", "1.30.0")
        if not pulled.endswith(made):  # Helm prints the address of the pull first
            raise ReleaseFault(f"the chart of {wanted[0]} makes other objects than {package.name}")


def check_pulled(image: str, pushed: str) -> None:
    """Push an image, pull the image, and run it."""
    identity = ("docker", "image", "inspect", "--format", "{{.Id}}")
    before = run(*identity, image)
    try:
        run("docker", "tag", image, pushed)
        run("docker", "push", pushed)
        run("docker", "rmi", pushed)
        run("docker", "pull", pushed)
        if run(*identity, pushed) != before:
            raise ReleaseFault(f"{image} differs after push and pull")
        run("docker", "run", "--rm", "--network", "none", pushed, "--version")
    finally:
        subprocess.run(["docker", "rmi", pushed], capture_output=True, check=False)


@contextmanager
def running_registry(directory: Path) -> Iterator[str]:
    """Run a registry on loopback, where Docker needs no TLS. Yield the address."""
    program = run(ROOT / "scripts/install-registry.sh").splitlines()[-1]
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    storage = {"filesystem": {"rootdirectory": str(directory / "data")}}
    config = {
        "version": 0.1,
        "storage": storage,
        "http": {"addr": address},
        "log": {"level": "warn"},
    }
    (directory / "config.yml").write_text(json.dumps(config))
    log = directory / "log"
    with log.open("wb") as output:
        process = subprocess.Popen([program, "serve", str(directory / "config.yml")],
                                   stdout=output, stderr=output)  # fmt: skip
    try:
        end = time.monotonic() + 30
        while not answers(address):
            if process.poll() is not None or time.monotonic() > end:
                raise ReleaseFault(f"the registry does not start:\n{log.read_text()}")
            time.sleep(0.1)
        yield address
    finally:
        process.terminate()
        process.wait(30)


def answers(address: str) -> bool:
    try:
        with urllib.request.urlopen(f"http://{address}/v2/", timeout=5):
            return True
    except OSError:
        return False


STEPS: dict[str, Callable[[Release], None]] = {
    "versions": check_versions,
    "packages": check_packages,
    "sbom": check_sbom,
    "chart": check_chart,
    "images": check_images,
    "registry": check_registry,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--tag", default="", help="the release's tag in git: v and the version")
    parser.add_argument("--base-image", default="", help="the base image")
    parser.add_argument("--registry", default="", help="the prefix of the images' names")
    parser.add_argument("--repository", default="", help="the URL for links in chart and alerts")
    parser.add_argument("--only", nargs="+", choices=STEPS, default=list(STEPS), metavar="STEP")
    options = parser.parse_args()
    DIST.mkdir(exist_ok=True)
    try:
        registry = options.registry.strip("/")
        repository = options.repository.strip("/")
        release = Release(project_version(), options.tag, options.base_image, registry, repository)
        for name in options.only:
            print(f"{name} …", flush=True)
            STEPS[name](release)
    except ReleaseFault as error:
        print(f"release-check: {error}", file=sys.stderr)
        return 1
    print(f"rosproxy {release.version} is in {DIST.relative_to(ROOT)}:")
    for path in sorted(DIST.iterdir()):
        print(f"  {digest(path)[:16]}  {path.name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
