"""Mounts below a directory."""

from pathlib import Path

from tests.docker.engine import run


def below(directory: Path) -> list[str]:
    """The mount points below a directory, the innermost first."""
    points = [line.split()[4] for line in Path("/proc/self/mountinfo").read_text().splitlines()]
    mine = [point.replace("\\040", " ") for point in points if point.startswith(f"{directory}/")]
    return sorted(mine, key=len, reverse=True)


def unmount_below(directory: Path) -> None:
    while points := below(directory):
        run("umount", "--lazy", *points)
