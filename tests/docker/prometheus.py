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
    """One that runs; ``url`` is where it answers, ``since`` when it began, in Unix time."""

    url: str
    since: float

    def ask(self, path: str, **words: str) -> Any:
        """What its API answers."""
        query = urllib.parse.urlencode(words)
        with urllib.request.urlopen(f"{self.url}/api/v1/{path}?{query}", timeout=10) as reply:
            return json.load(reply)["data"]

    def series(self, query: str) -> list[dict[str, str]]:
        """The labels of what a query has given at any time since the beginning."""
        now = time.time()
        step = str(max(1, round((now - self.since) / 500)))
        found = self.ask("query_range", query=query, start=f"{self.since}", end=f"{now}", step=step)
        return [one["metric"] for one in found["result"]]

    def firing(self) -> list[dict[str, Any]]:
        """The alerts that fire now."""
        return [one for one in self.ask("alerts")["alerts"] if one["state"] == "firing"]

    def wait_for_alert(self, name: str, seconds: float = 60, **labels: str) -> dict[str, Any]:
        """Wait until an alert with these labels fires, and return it."""
        wanted = {"alertname": name, **labels}.items()

        def found() -> list[dict[str, Any]]:
            return [one for one in self.firing() if wanted <= one["labels"].items()]

        wait_until(lambda: bool(found()), seconds, lambda: f"{wanted} in {self.firing()}")
        return found()[0]

    def answering(self) -> set[tuple[str, str]]:
        """The targets that answer, by job and instance."""
        labels = [
            one["labels"] for one in self.ask("targets")["activeTargets"] if one["health"] == "up"
        ]
        return {(one["job"], one["instance"]) for one in labels}


def guides_configuration(directory: Path, operator: str) -> Any:
    """The guide's configuration for Docker; ``operator`` is where the operator's metrics are.

    It looks each second, and alerts fire at once: how long what they name has to last is held in
    tests/chart.
    """
    rules = yaml.safe_load(ALERTS.read_text())
    for rule in rules["groups"][0]["rules"]:
        rule.pop("for", None)
    (directory / "alerts.yaml").write_text(yaml.safe_dump(rules))
    config = scrape_configs()[0]
    config["global"] = {"scrape_interval": "1s", "evaluation_interval": "1s"}
    proxies, operators = config["scrape_configs"]
    (discovery,) = proxies["docker_sd_configs"]
    discovery |= {"host": engine_url(), "refresh_interval": "1s"}
    operators["static_configs"][0]["targets"] = [operator]
    return config


@contextmanager
def running_prometheus(directory: Path, config: Any) -> Iterator[Prometheus]:
    """Prometheus as a program of this host, with its files in a directory."""
    path = directory / "prometheus.yml"
    path.write_text(yaml.safe_dump(config))
    where = f"127.0.0.1:{free_ports(1)}"
    words = [f"--config.file={path}", f"--storage.tsdb.path={directory / 'data'}",
             f"--web.listen-address={where}", "--log.level=warn"]  # fmt: skip
    log = directory / "prometheus.log"
    with log.open("wb") as output:
        process = subprocess.Popen(["prometheus", *words], stdout=output, stderr=output)
    found = Prometheus(f"http://{where}", time.time())
    try:
        wait_until(lambda: process.poll() is not None or _ready(found), 30, log.read_text)
        assert process.poll() is None, log.read_text()
        yield found
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
