"""A real Prometheus; also with the guide's configuration, all alerts and shorter times."""

import json
import subprocess
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from examples.demo.fake_http import free_ports
from tests.chart.monitoring import ALERTS, scrape_configs
from tests.docker.engine import engine_url, wait_until


@dataclass(frozen=True)
class Prometheus:
    """A running Prometheus at ``url``. ``since`` is the start in Unix time."""

    url: str
    since: float

    def ask(self, path: str, **words: str) -> Any:
        """The answer of the API."""
        query = urllib.parse.urlencode(words)
        with urllib.request.urlopen(f"{self.url}/api/v1/{path}?{query}", timeout=10) as reply:
            return json.load(reply)["data"]

    def series(self, query: str) -> list[dict[str, str]]:
        """The labels of what a query has given at any time since the beginning."""
        now = time.time()
        step = str(max(1, round((now - self.since) / 500)))
        answer = self.ask(
            "query_range", query=query, start=f"{self.since}", end=f"{now}", step=step
        )
        return [series["metric"] for series in answer["result"]]

    def wait_for_data(self, panels: list[tuple[str, str]]) -> None:
        """Wait until each query, given with its title, has had data since the start."""

        def empty() -> list[tuple[str, str]]:
            return [panel for panel in panels if not self.series(panel[1])]

        wait_until(lambda: not empty(), 30, lambda: f"without data: {empty()}")

    def firing(self) -> list[dict[str, Any]]:
        """The alerts that fire now."""
        return [alert for alert in self.ask("alerts")["alerts"] if alert["state"] == "firing"]

    def wait_for_alert(self, name: str, seconds: float = 60, **labels: str) -> dict[str, Any]:
        """Wait until an alert with these labels fires. Return the alert."""
        wanted = {"alertname": name, **labels}.items()

        def matching_alerts() -> list[dict[str, Any]]:
            return [alert for alert in self.firing() if wanted <= alert["labels"].items()]

        wait_until(lambda: bool(matching_alerts()), seconds, lambda: f"{wanted} in {self.firing()}")
        return matching_alerts()[0]

    def targets(self) -> list[dict[str, Any]]:
        """All scraped targets, also without an answer."""
        active: list[dict[str, Any]] = self.ask("targets", state="active")["activeTargets"]
        return active

    def answering(self) -> set[tuple[str, str]]:
        """The targets that answer, by job and instance."""
        labels = [target["labels"] for target in self.targets() if target["health"] == "up"]
        return {(target_labels["job"], target_labels["instance"]) for target_labels in labels}


def guides_configuration(directory: Path, operator: str) -> Any:
    """The guide's configuration for Docker; ``operator`` is where the operator's metrics are."""
    config = scrape_configs()[0]
    config |= hurried(directory, yaml.safe_load(ALERTS.read_text()))
    proxies, operators = config["scrape_configs"]
    (discovery,) = proxies["docker_sd_configs"]
    discovery |= {"host": engine_url(), "refresh_interval": "1s"}
    operators["static_configs"][0]["targets"] = [operator]
    return config


def hurried(directory: Path, rules: Any) -> Any:
    """A configuration to scrape each second, and a file of the rules without delays.

    tests/chart tests the delays.
    """
    for rule in rules["groups"][0]["rules"]:
        rule.pop("for", None)
    (directory / "alerts.yaml").write_text(yaml.safe_dump(rules))
    return {"global": {"scrape_interval": "1s", "evaluation_interval": "1s"}}


@contextmanager
def running_prometheus(directory: Path, config: Any) -> Iterator[Prometheus]:
    """Run Prometheus as a program of this host, with all files in a directory."""
    path = directory / "prometheus.yml"
    path.write_text(yaml.safe_dump(config))
    address = f"127.0.0.1:{free_ports(1)}"
    words = [f"--config.file={path}", f"--storage.tsdb.path={directory / 'data'}",
             f"--web.listen-address={address}", "--log.level=warn"]  # fmt: skip
    log = directory / "prometheus.log"
    with log.open("wb") as output:
        process = subprocess.Popen(["prometheus", *words], stdout=output, stderr=output)
    prometheus = Prometheus(f"http://{address}", time.time())
    try:
        wait_until(lambda: process.poll() is not None or _ready(prometheus), 30, log.read_text)
        assert process.poll() is None, log.read_text()
        yield prometheus
    finally:
        process.terminate()
        process.wait(30)
        print(log.read_text())


def _ready(prometheus: Prometheus) -> bool:
    try:
        with urllib.request.urlopen(f"{prometheus.url}/-/ready", timeout=5) as reply:
            return bool(reply.status == 200)
    except OSError:
        return False
