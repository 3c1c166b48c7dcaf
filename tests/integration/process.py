"""The proxy of a test as a separate process, for observations from outside."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from examples.demo.fake_http import Address
from examples.demo.proxy_process import clean_environment
from tests.integration.net import PROXY
from tests.integration.proxy import BY_THE_WALL, options_for


def command_line(options: dict[str, Any]) -> list[str]:
    """The command that runs a proxy with these options; True stands for a flag."""
    command = [sys.executable, "-m", "rosproxy", "run"]
    for name, setting in options.items():
        option = "--" + name.replace("_", "-")
        values = setting if isinstance(setting, tuple) else (setting,)
        for value in values:
            command += [option] if value is True else [option, str(value)]
    return command


class Process:
    """A running ``rosproxy run``.

    ``log`` are the lines on standard error so far. The option ``prefix`` is a command that runs the
    proxy.
    """

    def __init__(self, options: dict[str, Any]) -> None:
        self.prefix = options.pop("prefix", [])
        self.options = options_for(**BY_THE_WALL | options)
        self.master: Address = (PROXY, int(self.options["master_port"]))
        self.log: list[str] = []
        self.start()

    def start(self) -> None:
        """Start or restart the proxy with the same options, and wait until ready."""
        self._before = len(self.log)
        command = [*self.prefix, *command_line(self.options)]
        self._process = subprocess.Popen(
            command, stderr=subprocess.PIPE, text=True, env=clean_environment()
        )
        self._reader = threading.Thread(target=self._read, args=(self._process,))
        self._reader.start()
        self.wait_for_log("listening: ")

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    @property
    def text(self) -> str:
        """The log since the last start."""
        return "".join(self.log[self._before :])

    def wait_for_log(self, text: str, within: float = 60.0) -> None:
        """Wait until a line of the log holds ``text``."""
        end = monotonic() + within
        while text not in self.text:
            assert monotonic() < end, f"no {text!r} in the log:\n{self.text}"
            assert self._process.poll() is None, f"the proxy ended:\n{self.text}"
            sleep(0.01)

    def resident(self) -> int:
        """The private memory in bytes."""
        lines = Path(f"/proc/{self.pid}/smaps_rollup").read_text().splitlines()
        return 1024 * sum(int(line.split()[1]) for line in lines if line.startswith("Private_"))

    def most_memory(self) -> int:
        """The peak of resident memory in bytes."""
        lines = Path(f"/proc/{self.pid}/status").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM"))

    def descriptors(self) -> int:
        """The number of open file descriptors."""
        return len(os.listdir(f"/proc/{self.pid}/fd"))

    def threads(self) -> int:
        """The number of threads."""
        return len(os.listdir(f"/proc/{self.pid}/task"))

    def terminate(self, number: int = signal.SIGTERM) -> int:
        """Send a signal and wait for the end; the exit code."""
        self._process.send_signal(number)
        code = self._process.wait(60)
        self._reader.join()
        return code

    def kill(self) -> None:
        """SIGKILL it."""
        self.terminate(signal.SIGKILL)

    def close(self) -> None:
        """Kill the process if necessary. A traceback in the log fails the test."""
        if self._process.poll() is None:
            self.kill()
        assert "Traceback" not in "".join(self.log), "".join(self.log)

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr
        with process.stderr as lines:
            self.log += lines
