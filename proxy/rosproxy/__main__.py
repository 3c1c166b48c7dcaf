"""``python -m rosproxy``."""

from rosproxy.cli import main

main(prog_name="rosproxy")
