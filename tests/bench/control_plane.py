"""etcd and an API server for the benchmark, and their clients, without kubelet and scheduler.

The programs of tests/kubernetes run on loopback and in a separate folder, so that a cluster of
those tests is not in the way. The API server's audit log has the number of requests of each user.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
import subprocess
import time
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import aiohttp
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from tests.kubernetes.cluster.layout import BIN

ROOT = Path(__file__).resolve().parents[2]
OPERATOR = "system:serviceaccount:rosproxy-system:rosproxy-operator"
_ADMIN = "the-benchmark"
_AUDIT = {
    "apiVersion": "audit.k8s.io/v1",
    "kind": "Policy",
    "omitStages": ["RequestReceived", "ResponseStarted"],
    "rules": [{"level": "Metadata", "users": [OPERATOR]}, {"level": "None"}],
}
AT_ONCE = 16
"""Objects that are written at the same time."""
_PATIENCE = 60.0
Json = dict[str, Any]


class ControlPlane:
    """The two programs in a folder; `session` is the administrator's."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.url = f"https://127.0.0.1:{free_port()}"
        self._etcd = [f"http://127.0.0.1:{free_port()}", f"http://127.0.0.1:{free_port()}"]
        self.programs: list[subprocess.Popen[bytes]] = []
        self.session: aiohttp.ClientSession
        self._room = asyncio.Semaphore(AT_ONCE)

    @property
    def api_server(self) -> int:
        """The process id of the API server."""
        return self.programs[1].pid

    async def __aenter__(self) -> ControlPlane:
        headers = {"Authorization": f"Bearer {_ADMIN}"}
        connector = aiohttp.TCPConnector(ssl=False, limit=0)
        unbounded = aiohttp.ClientTimeout(total=None)
        self.session = aiohttp.ClientSession(
            self.url, headers=headers, connector=connector, timeout=unbounded
        )
        try:
            self._start()
            await self._ready()
            await self._install()
        except BaseException:
            await self.__aexit__()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.session.close()
        for program in reversed(self.programs):
            program.kill()
            program.wait()

    def _start(self) -> None:
        key = ec.generate_private_key(ec.SECP256R1())
        pem = key.private_bytes(Encoding.PEM, PrivateFormat.TraditionalOpenSSL, NoEncryption())
        (self.folder / "key.pem").write_bytes(pem)
        (self.folder / "tokens").write_text(f"{_ADMIN},admin,admin,system:masters\n")
        (self.folder / "audit.json").write_text(json.dumps(_AUDIT))
        self._run(
            "etcd", f"--data-dir={self.folder}/etcd", "--unsafe-no-fsync", "--log-level=error",
            f"--listen-client-urls={self._etcd[0]}", f"--advertise-client-urls={self._etcd[0]}",
            f"--listen-peer-urls={self._etcd[1]}", "--quota-backend-bytes=4294967296",
        )  # fmt: skip
        self._run(
            "kube-apiserver", f"--etcd-servers={self._etcd[0]}", "--bind-address=127.0.0.1",
            f"--secure-port={self.url.rpartition(':')[2]}", f"--cert-dir={self.folder}/pki",
            "--service-cluster-ip-range=10.96.0.0/16", "--authorization-mode=RBAC",
            f"--token-auth-file={self.folder}/tokens",
            f"--service-account-key-file={self.folder}/key.pem",
            f"--service-account-signing-key-file={self.folder}/key.pem",
            "--service-account-issuer=https://kubernetes.default.svc",
            "--disable-admission-plugins=ServiceAccount", "--endpoint-reconciler-type=none",
            "--advertise-address=192.0.2.1",
            f"--audit-policy-file={self.folder}/audit.json",
            f"--audit-log-path={self.folder}/audit.log",
        )  # fmt: skip

    def _run(self, name: str, *options: str) -> None:
        with (self.folder / f"{name}.log").open("wb") as log:
            self.programs.append(
                subprocess.Popen([BIN / name, *options], stdout=log, stderr=log, cwd="/")
            )

    async def _ready(self) -> None:
        end = time.monotonic() + _PATIENCE
        while True:
            for program in self.programs:
                assert program.poll() is None, f"{program.args!r} has ended: see {self.folder}"
            with suppress(aiohttp.ClientError):
                async with self.session.get("/readyz") as reply:
                    if reply.status == 200:
                        return
            assert time.monotonic() < end, f"the API server is not ready: see {self.folder}"
            await asyncio.sleep(0.2)

    async def _install(self) -> None:
        """Install the manifests without the webhook, which no program serves here."""
        self.write_kubeconfig("admin", _ADMIN)
        self.kubectl("create", "namespace", "rosproxy-system")
        self.kubectl("apply", "-f", str(ROOT / "manifests/install.yaml"))
        self.kubectl("delete", "mutatingwebhookconfigurations", "--all")
        self.kubectl("wait", "--for=condition=Established", "crd/rosproxies.rosproxy.io")
        name = OPERATOR.rpartition(":")[2]
        token = self.kubectl("create", "token", "-n", "rosproxy-system", name, "--duration=9h")
        self.write_kubeconfig("operator", token.strip())

    def kubectl(self, *words: str) -> str:
        """Run kubectl as the administrator. Return the output."""
        config = f"--kubeconfig={self.folder}/admin"
        command = [str(BIN / "kubectl"), config, *words]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        if done.returncode and "already exists" not in done.stderr:
            raise RuntimeError(f"kubectl {' '.join(words)}: {done.stderr}")
        return done.stdout

    def write_kubeconfig(self, name: str, token: str) -> None:
        config = {
            "apiVersion": "v1",
            "kind": "Config",
            "clusters": [
                {"name": "c", "cluster": {"server": self.url, "insecure-skip-tls-verify": True}}
            ],
            "users": [{"name": "u", "user": {"token": token}}],
            "contexts": [{"name": "x", "context": {"cluster": "c", "user": "u"}}],
            "current-context": "x",
        }
        (self.folder / name).write_text(json.dumps(config))

    async def call(self, method: str, path: str, body: Json | None = None, kind: str = "") -> Json:
        """A call of the administrator. Objects that exist already, or are gone, are no errors."""
        headers = {"Content-Type": kind} if kind else {}
        data = json.dumps(body) if body is not None else None
        headers.setdefault("Content-Type", "application/json")
        async with (
            self._room,
            self.session.request(method, path, data=data, headers=headers) as reply,
        ):
            document: Json = await reply.json()
            assert reply.status < 300 or reply.status in (404, 409), document
            return document

    async def set_status(self, path: str, status: Json) -> None:
        """Write the status of an object."""
        merge = "application/merge-patch+json"
        await self.call("PATCH", f"{path}/status", {"status": status}, merge)

    async def watch(self, path: str, **query: str) -> AsyncIterator[Json]:
        """The events of a list, from what is there on."""
        async with self.session.get(path, params={"watch": "1", **query}) as reply:
            assert reply.status == 200, await reply.text()
            buffer = b""
            async for chunk in reply.content.iter_any():
                *lines, buffer = (buffer + chunk).split(b"\n")
                for line in lines:
                    yield json.loads(line)

    def asked(self) -> Counter[str]:
        """The requests of the operator so far, by verb and resource."""
        requests: Counter[str] = Counter()
        log = self.folder / "audit.log"
        for line in log.read_text().splitlines() if log.exists() else ():
            event = json.loads(line)
            requests[f"{event['verb']} {event.get('objectRef', {}).get('resource', '')}"] += 1
        return requests


def is_there() -> bool:
    """Whether the programs have been built."""
    return all(os.access(BIN / name, os.X_OK) for name in ("etcd", "kube-apiserver", "kubectl"))


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])
