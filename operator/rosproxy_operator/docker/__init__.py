"""The operator of a Docker host."""
