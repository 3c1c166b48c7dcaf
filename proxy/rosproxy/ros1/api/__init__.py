"""The master API for nodes inside, and their slave APIs for the master and nodes outside."""
