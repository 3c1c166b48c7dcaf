"""The C++ programs of the benchmark, compiled once for each version of the sources."""

from __future__ import annotations

import hashlib
import os
import subprocess
from pathlib import Path

SOURCES = Path(__file__).parent / "cpp"
CACHE = Path(__file__).parents[2] / "build" / "bench-programs"
FLAGS = ("-std=c++17", "-O2", "-w", "-DBOOST_BIND_GLOBAL_PLACEHOLDERS")


def compiled(name: str, *packages: str) -> Path:
    """The path of a program.

    Raises RuntimeError with the compiler's output. ``packages`` are the names of the needed
    libraries for pkg-config.
    """
    source = SOURCES / f"{name}.cpp"
    words = " ".join([*FLAGS, *packages, source.read_text()])
    program = CACHE / f"{name}-{hashlib.sha256(words.encode()).hexdigest()[:16]}"
    if not program.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        _compile(source, program, packages)
    return program


def _compile(source: Path, program: Path, packages: tuple[str, ...]) -> None:
    unfinished = program.with_suffix(f".{os.getpid()}")
    libraries = _output("pkg-config", "--cflags", "--libs", *packages).split() if packages else []
    _output("g++", *FLAGS, str(source), "-o", str(unfinished), "-pthread", *libraries)
    unfinished.rename(program)


def _output(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}:\n{done.stderr.strip()[-3000:]}")
    return done.stdout
