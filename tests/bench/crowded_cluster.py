"""Fake nodes: the writes of a scheduler and kubelets, and a web server for all proxies.

All proxies have loopback addresses of this machine, so that a single server answers for all.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from typing import Any

from aiohttp import web

from tests.bench.control_plane import ControlPlane

ROBOTS = "robots"
OTHERS = "others"
MASTER = "http://10.96.7.7:11311"
"""The proxy's URI in pods. The RosProxy's Service gets this address."""
ADMIN_PORT = 11312
OWN = "app.kubernetes.io/component=proxy"
_READY = [{"type": "Ready", "status": "True"}]
STATUS = {
    "settings": {"ros": "1"},
    "master": {"up": True, "uri": "http://192.0.2.1:11311"},
    "nodes": [],
}


class CrowdedCluster:
    """Nodes, pods, and their kubelets. ``made`` has the time when the proxy of a node appeared."""

    def __init__(self, plane: ControlPlane) -> None:
        self.plane = plane
        self.made = dict[str, float]()
        self._seen = asyncio.Condition()
        self._bound: set[str] = set()
        self._numbers = itertools.count(1)
        self._tasks: list[asyncio.Task[None]] = []
        self._doing: set[asyncio.Task[None]] = set()
        self._server: web.ServerRunner | None = None

    async def __aenter__(self) -> CrowdedCluster:
        await self._serve()
        self._tasks.append(asyncio.create_task(self._look_after_proxies()))
        return self

    async def __aexit__(self, *_: object) -> None:
        for task in (*self._tasks, *self._doing):
            task.cancel()
        await asyncio.gather(*self._tasks, *self._doing, return_exceptions=True)
        if self._server is not None:
            await self._server.cleanup()

    # what is there

    async def fill(self, nodes: int, pods: int) -> None:
        """Add nodes with a labelled pod each, and other pods up to ``pods``."""
        for name in (ROBOTS, OTHERS):
            await self.plane.call("POST", "/api/v1/namespaces", {"metadata": {"name": name}})
        spec = {"master": {"uri": "http://192.0.2.1:11311"}, "ports": 8}
        body = {
            "apiVersion": "rosproxy.io/v1alpha1", "kind": "RosProxy",
            "metadata": {"name": "fleet"}, "spec": spec,
        }  # fmt: skip
        await self.plane.call(
            "POST", f"/apis/rosproxy.io/v1alpha1/namespaces/{ROBOTS}/rosproxies", body
        )
        await asyncio.gather(*(self.add_node(f"node{number}") for number in range(nodes)))
        await asyncio.gather(*(self.add_robot(f"node{number}") for number in range(nodes)))
        spare = max(pods - nodes, 0)
        await asyncio.gather(
            *(self.add_other(f"other-{number}", f"node{number % nodes}") for number in range(spare))
        )

    async def add_node(self, name: str) -> None:
        number = next(self._numbers)
        body = {
            "metadata": {"name": name},
            "spec": {"podCIDR": f"127.{1 + number // 250}.{number % 250}.0/24"},
        }
        await self.plane.call("POST", "/api/v1/nodes", body)
        address = {"type": "InternalIP", "address": f"10.0.{number // 250}.{number % 250 + 1}"}
        await self.plane.set_status(
            f"/api/v1/nodes/{name}", {"addresses": [address], "conditions": _READY}
        )

    async def add_robot(self, node: str) -> float:
        """Add a labelled pod. Return the time of the binding."""
        name = f"robot-{node}"
        labels = {"rosproxy.io/inject": "true", "app": "robot"}
        path = f"/api/v1/namespaces/{ROBOTS}/pods"
        body = _pod(name, node, labels)
        body["metadata"]["annotations"] = {"rosproxy.io/master-uri": MASTER}  # by the webhook
        body["spec"]["containers"][0]["env"].append({"name": "ROS_MASTER_URI", "value": MASTER})
        await self.plane.call("POST", path, body)
        bound = time.monotonic()
        await self.plane.set_status(f"{path}/{name}", {"phase": "Running", "podIP": self._ip()})
        return bound

    async def add_other(self, name: str, node: str) -> None:
        """Add an unrelated pod, of a Deployment of 20."""
        app = f"app-{hash(name) % 1500}"
        labels = {"app": app, "pod-template-hash": "5d9c7b8f6", "team": f"team-{len(app)}"}
        path = f"/api/v1/namespaces/{OTHERS}/pods"
        await self.plane.call("POST", path, _pod(name, node, labels))

    async def churn(self, nodes: int, a_second: float) -> None:
        """Let unrelated pods come and go until cancelled."""
        path = f"/api/v1/namespaces/{OTHERS}/pods"

        async def come_and_go(name: str, node: str) -> None:
            await self.add_other(name, node)
            status = {"phase": "Running", "podIP": self._ip(), "conditions": _READY}
            await self.plane.set_status(f"{path}/{name}", status)
            await asyncio.sleep(2.0)
            await self.plane.call("DELETE", f"{path}/{name}")

        for number in itertools.count():
            self._do(come_and_go(f"churn-{number}", f"node{number % nodes}"))
            await asyncio.sleep(1.0 / a_second)

    # what the operator makes

    async def all_made(self, count: int, seconds: float) -> None:
        """Wait until so many nodes have a proxy. TimeoutError."""
        async with asyncio.timeout(seconds), self._seen:
            await self._seen.wait_for(lambda: len(self.made) >= count)

    async def made_on(self, node: str, seconds: float) -> float:
        """The time when the proxy of a node was created. Raises TimeoutError."""
        async with asyncio.timeout(seconds), self._seen:
            await self._seen.wait_for(lambda: node in self.made)
        return self.made[node]

    async def _look_after_proxies(self) -> None:
        while True:  # the API server ends a watch after a while
            async for event in self.plane.watch("/api/v1/pods", labelSelector=OWN):
                if event["type"] in ("ADDED", "MODIFIED"):
                    await self._look_after(event["object"])

    async def _look_after(self, pod: dict[str, Any]) -> None:
        meta = pod["metadata"]
        node = pod["metadata"]["annotations"]["rosproxy.io/node"]
        path = f"/api/v1/namespaces/{ROBOTS}/pods/{meta['name']}"
        async with self._seen:
            self.made.setdefault(node, time.monotonic())
            self._seen.notify_all()
        if meta.get("deletionTimestamp"):
            self._do(self._call("DELETE", path, {"gracePeriodSeconds": 0}))
        elif meta["uid"] not in self._bound:
            self._bound.add(meta["uid"])
            self._do(self._run(path, meta["name"], node))

    async def _run(self, path: str, name: str, node: str) -> None:
        """Bind and run a pod, like scheduler and kubelet."""
        target = {"apiVersion": "v1", "kind": "Node", "name": node}
        await self._call(
            "POST", f"{path}/binding",
            {"apiVersion": "v1", "kind": "Binding", "metadata": {"name": name}, "target": target},
        )  # fmt: skip
        status = {"phase": "Running", "podIP": self._ip(), "conditions": _READY}
        await self.plane.set_status(path, status)

    async def _call(self, method: str, path: str, body: dict[str, Any]) -> None:
        await self.plane.call(method, path, body)

    def _do(self, work: Any) -> None:
        task = asyncio.create_task(work)
        self._doing.add(task)
        task.add_done_callback(self._doing.discard)

    def _ip(self) -> str:
        number = next(self._numbers)
        return f"127.{10 + number // 62500}.{number // 250 % 250}.{number % 250 + 1}"

    # the proxies

    async def _serve(self) -> None:
        self._server = web.ServerRunner(web.Server(self._answer))
        await self._server.setup()
        await web.TCPSite(self._server, "0.0.0.0", ADMIN_PORT, backlog=4096).start()

    async def _answer(self, request: web.BaseRequest) -> web.Response:
        """The answer of a proxy without events."""
        if request.path == "/status/changes":
            if request.query.get("since") == "1":
                await asyncio.sleep(float(request.query.get("within", "25")))
            return web.json_response({"version": "1", "status": STATUS})
        return web.json_response(STATUS if request.method == "GET" else {})


def _pod(name: str, node: str, labels: dict[str, str]) -> dict[str, Any]:
    variables = [{"name": f"SETTING_{number}", "value": "something"} for number in range(8)]
    container = {"name": "main", "image": "registry.example/app:1", "env": variables}
    return {
        "metadata": {"name": name, "labels": labels},
        "spec": {"nodeName": node, "containers": [container], "terminationGracePeriodSeconds": 0},
    }
