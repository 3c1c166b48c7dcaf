"""Bounds on the memory and the threads of processes: a cgroup, of version 1 or 2.

The machine's version decides. In version 1 memory and threads have separate groups.
"""

from pathlib import Path

ROOT = Path("/sys/fs/cgroup")
V1_MEMORY = ROOT / "memory"
V1_PIDS = ROOT / "pids"


class Cgroup:
    """A cgroup with a limit on memory in bytes and without swap, which requires root."""

    def __init__(self, name: str, most: int) -> None:
        if (V1_MEMORY / "memory.limit_in_bytes").exists():
            self._dirs = [V1_MEMORY / name, V1_PIDS / name]
            files = "memory.limit_in_bytes", "memory.memsw.limit_in_bytes"
        else:
            (ROOT / "cgroup.subtree_control").write_text("+memory +pids")
            self._dirs = [ROOT / name]
            files = "memory.max", "memory.swap.max"
        for folder in self._dirs:
            folder.mkdir()
        (self._dirs[0] / files[0]).write_text(str(most))
        swap = self._dirs[0] / files[1]
        if swap.exists():  # missing if the kernel does not count swap
            swap.write_text("0" if files[1] == "memory.swap.max" else str(most))

    @property
    def prefix(self) -> list[str]:
        """The words to put before a command to run the command in this group."""
        enter = "; ".join(f"echo $$ > {folder}/cgroup.procs" for folder in self._dirs)
        return ["sh", "-ec", f'{enter}; exec "$@"', "sh"]

    def limit_threads(self, more: int | None) -> None:
        """Let there be so many more threads than now; None: as many as are wanted."""
        folder = self._dirs[-1]
        now = int((folder / "pids.current").read_text())
        (folder / "pids.max").write_text("max" if more is None else str(now + more))

    def remove(self) -> None:
        """Remove the group, which must be empty."""
        for folder in self._dirs:
            folder.rmdir()
