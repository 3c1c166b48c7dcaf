"""``make bench``: rosproxy beside a direct connection and other relays.

All ways take turns in every round, so that a busy moment of the machine affects all ways. The
numbers are saved after each section, so that an interrupted run keeps its results.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import sys
import time
import traceback
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from tests.bench import machine, report
from tests.bench.book import Book
from tests.bench.world import DESCRIPTORS, PREFIX
from tests.ros.topology import remove_leftovers

FOLDER = Path("build/bench")


class Section(NamedTuple):
    """The meaning of the sizes in a part of the benchmark, and the number of rounds."""

    axis: str
    rounds: int


SECTIONS = {
    "streams": Section("connections", 5),
    "control": Section("nodes", 5),
    "nodes": Section("nodes", 1),
    "ros": Section("bytes", 3),
    "ros2": Section("participants", 5),
    "rmw_zenoh": Section("containers", 5),
    "page": Section("nodes", 3),
    "cluster": Section("nodes", 1),
    "docker": Section("containers", 1),
}
"""Each is a module beside with a ``run(book, rounds, quick)``."""


def main() -> None:
    options = parse()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    if os.geteuid() != 0:
        sys.exit("make bench lays out network namespaces: run it as root")
    raise_limits()
    remove_leftovers(PREFIX)
    book = Book(machine.described())
    print(*(f"{name + ':':<10}{text}" for name, text in book.machine.items()), sep="\n", flush=True)
    whole = [measured(book, name, options) for name in options.sections]
    report.write(book, options.folder)
    print(f"\nresults.json, performance.md and plots are in {options.folder}")
    sys.exit(not all(whole))


def measured(book: Book, name: str, options: argparse.Namespace) -> bool:
    """Run a section, then save and show the results so far. Return whether the section was
    complete.
    """
    section = SECTIONS[name]
    book.begin(name, section.axis)
    started = time.monotonic()
    rounds = 1 if options.quick else options.rounds or section.rounds
    print(f"\nmeasuring {name}, rounds: {rounds}", flush=True)
    try:
        import_module(f"tests.bench.{name}").run(book, rounds, options.quick)
    except Exception as error:
        book.note(f"the measurements broke off: {error!r}")
        traceback.print_exc()
        return False
    finally:
        book.machine[f"{name} took"] = f"{time.monotonic() - started:.0f} s"
        book.save(options.folder / "results.json")
        report.print_table(book, name)
    return True


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description=__doc__)
    section_names = ", ".join(SECTIONS)
    parser.add_argument(
        "--sections",
        type=sections,
        default=list(SECTIONS),
        help=f"some of {section_names}, with commas",
    )
    parser.add_argument("--rounds", type=int, help="instead of the default of each section")
    parser.add_argument("--quick", action="store_true", help="a short round, for a first look")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="where the results go")
    return parser.parse_args()


def sections(text: str) -> list[str]:
    names = text.split(",")
    if unknown := [name for name in names if name not in SECTIONS]:
        raise argparse.ArgumentTypeError(f"{unknown[0]!r} is none of {', '.join(SECTIONS)}")
    return names


def raise_limits() -> None:
    """A thousand connections are two thousand open files in a relay, and twice that in pipes."""
    wanted = DESCRIPTORS, DESCRIPTORS
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, wanted)
    except (OSError, ValueError):
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


if __name__ == "__main__":
    main()
