"""``python -m rosproxy``."""

from rosproxy.cli.main import main

main(prog_name="rosproxy")
