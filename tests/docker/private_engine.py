"""A private engine in a separate network namespace, which tests may restart."""

import contextlib
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

from tests.docker.engine import docker, run, wait_until


class PrivateEngine:
    """An engine with separate containers and networks."""

    def __init__(self, directory: Path) -> None:
        self.name = f"rpx-engine-{os.getpid()}"
        self.namespace = f"/run/netns/{self.name}"
        self.url = f"unix://{directory}/docker.sock"
        self._directory = directory
        self._daemon: subprocess.Popen[bytes] | None = None

    def start(self, *options: str) -> None:
        # Not `ip netns exec`, which hides the control groups.
        command = ["nsenter", f"--net={self.namespace}", "dockerd", "--host", self.url,
                   "--data-root", f"{self._directory}/data", "--exec-root",
                   f"{self._directory}/run", "--pidfile", f"{self._directory}/pid",
                   "--userland-proxy=false", *options]  # fmt: skip
        with self.log.open("ab") as log:
            self._daemon = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        wait_until(self._answers, 60, self.log.read_text)

    def end(self, number: int = signal.SIGTERM) -> None:
        """End the engine, and its containers unless started with --live-restore."""
        assert self._daemon is not None
        self._daemon.send_signal(number)
        self._daemon.wait(60)
        # A killed engine leaves both files, and unreaped zombies make both processes seem alive.
        for left in ("pid", "run/containerd/containerd.pid"):
            (self._directory / left).unlink(missing_ok=True)

    def load(self, *images: str) -> None:
        """Load images of this machine's engine."""
        archive = self._directory / "images.tar"
        docker("save", "--output", archive, *images, seconds=120)
        docker("load", "--input", archive, seconds=120, engine=self.url)
        archive.unlink()

    @property
    def log(self) -> Path:
        return self._directory / "dockerd.log"

    def _answers(self) -> bool:
        assert self._daemon is not None
        assert self._daemon.poll() is None, self.log.read_text()[-2000:]
        return "Server Version" in docker("info", check=False, engine=self.url)

    def clear(self) -> None:
        """Remove all containers, end the engine and delete its data."""
        container_ids = docker("ps", "--all", "--quiet", engine=self.url, check=False).split()
        if container_ids:
            docker("rm", "--force", *container_ids, engine=self.url, check=False, seconds=120)
        self.end()
        for line in reversed(Path("/proc/self/mounts").read_text().splitlines()):
            mount = line.split()[1]
            if mount.startswith(str(self._directory)):
                run("umount", mount, check=False)
        shutil.rmtree(self._directory / "data", ignore_errors=True)


@contextlib.contextmanager
def private_engine(directory: Path) -> Iterator[PrivateEngine]:
    """An engine that runs, and that can be told to end and to start again."""
    engine = PrivateEngine(directory)
    run("ip", "netns", "add", engine.name)
    try:
        run("nsenter", f"--net={engine.namespace}", "ip", "link", "set", "lo", "up")
        engine.start()
        try:
            yield engine
        finally:
            engine.clear()
    finally:
        run("ip", "netns", "delete", engine.name)
