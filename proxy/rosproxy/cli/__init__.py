"""The command line ``rosproxy``."""
