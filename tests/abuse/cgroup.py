"""A bound on the memory of processes: a cgroup, of version 1 or 2, whichever the machine has."""

from pathlib import Path

ROOT = Path("/sys/fs/cgroup")
V1 = ROOT / "memory"


class MemoryGroup:
    """A cgroup with so many bytes of memory and no swap; root makes and removes it."""

    def __init__(self, name: str, most: int) -> None:
        if (V1 / "memory.limit_in_bytes").exists():
            self._dir, files = V1 / name, ("memory.limit_in_bytes", "memory.memsw.limit_in_bytes")
        else:
            (ROOT / "cgroup.subtree_control").write_text("+memory")
            self._dir, files = ROOT / name, ("memory.max", "memory.swap.max")
        self._dir.mkdir()
        (self._dir / files[0]).write_text(str(most))
        swap = self._dir / files[1]
        if swap.exists():  # not where the kernel does not count it
            swap.write_text("0" if files[1] == "memory.swap.max" else str(most))

    @property
    def prefix(self) -> list[str]:
        """A command that runs another one, which follows it, in this group."""
        enter = f'echo $$ > {self._dir}/cgroup.procs && exec "$@"'
        return ["sh", "-c", enter, "sh"]

    def remove(self) -> None:
        """Remove it; nothing may be left in it."""
        self._dir.rmdir()
