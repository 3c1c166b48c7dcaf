"""The operator of one Docker host."""
