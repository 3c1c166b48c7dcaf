"""The decisions of the Docker operator: pure functions without engine calls, clock and waiting."""
