"""A browser on a machine of the lab, driven over WebDriver (https://www.w3.org/TR/webdriver2/).

The tests need half a dozen calls of JSON over HTTP. A client library would need a dozen packages.
"""

from __future__ import annotations

import base64
import json
import shutil
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

from tests.ros.processes import Process, wait_until
from tests.ros.topology import Place

PORT = 9515
ARGUMENTS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
    *("--no-first-run", "--disable-extensions", "--disable-background-networking"),
    *("--force-device-scale-factor=1", "--hide-scrollbars"),
)
Json = dict[str, Any]


class Browser:
    """Chromium without a screen; `close` ends it."""

    def __init__(self, place: Place, folder: Path) -> None:
        self._place = place
        environment = {
            "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
            "HOME": str(folder),
            "LANG": "C.UTF-8",
        }
        command = [shutil.which("chromedriver") or "chromedriver", f"--port={PORT}"]
        self._driver = Process("chromedriver", place, command, environment, folder / "driver.log")
        wait_until("chromedriver answers", self._is_there)
        options = {"args": [*ARGUMENTS, f"--user-data-dir={folder}/profile"]}
        wanted = {"goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL"}}
        session = self._call("POST", "/session", capabilities={"alwaysMatch": wanted})
        self._session = f"/session/{session['sessionId']}"

    def close(self) -> None:
        """End the browser, then chromedriver."""
        try:
            self._call("DELETE", self._session)
        finally:
            self._driver.kill()

    def open(self, url: str) -> None:
        """Open a page, and wait until the page is loaded."""
        self._post("/url", url=url)

    def run(self, script: str, *arguments: Any) -> Any:
        """Run a script. Return the result."""
        return self._post("/execute/sync", script=script, args=list(arguments))

    def resize(self, width: int, height: int, scale: int = 1) -> None:
        """Set the size of the viewport in CSS pixels. ``scale``: pixels of a CSS pixel."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": False}
        self.devtools("Emulation.setDeviceMetricsOverride", **metrics)

    def prefer(self, scheme: str) -> None:
        """Set the preferred colour scheme, ``light`` or ``dark``."""
        feature = {"name": "prefers-color-scheme", "value": scheme}
        self.devtools("Emulation.setEmulatedMedia", features=[feature])

    def devtools(self, command: str, **parameters: Any) -> Any:
        """Call the DevTools protocol."""
        return self._post("/goog/cdp/execute", cmd=command, params=parameters)

    def press(self, keys: str) -> None:
        """Press keys for the element with the focus."""
        actions = [{"type": kind, "value": key} for key in keys for kind in ("keyDown", "keyUp")]
        source = {"type": "key", "id": "keyboard", "actions": actions}
        self._post("/actions", actions=[source])

    def screenshot(self) -> bytes:
        """The visible page, as PNG."""
        return base64.b64decode(self._call("GET", f"{self._session}/screenshot"))

    def small_screenshot(self, quality: int) -> bytes:
        """The visible page, as WebP with a quality in percent."""
        answer = self.devtools("Page.captureScreenshot", format="webp", quality=quality)
        return base64.b64decode(answer["data"])

    def console(self) -> list[str]:
        """The messages of the console since the previous call: errors, refused content."""
        return [str(row["message"]) for row in self._post("/se/log", type="browser")]

    def _post(self, path: str, **body: Any) -> Any:
        return self._call("POST", f"{self._session}{path}", **body)

    def _is_there(self) -> bool:
        try:
            return bool(self._call("GET", "/status")["ready"])
        except OSError:
            return False

    def _call(self, method: str, path: str, **body: Any) -> Any:
        with self._place.entered():
            connection = HTTPConnection("127.0.0.1", PORT, timeout=120)
            try:
                connection.request(method, path, json.dumps(body) if method == "POST" else None)
                reply = connection.getresponse()
                answer = json.loads(reply.read())["value"]
            finally:
                connection.close()
        assert reply.status == 200, answer
        return answer
