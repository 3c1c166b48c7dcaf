"""A running proxy: its parts put together, started and stopped."""
