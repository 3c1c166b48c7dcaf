"""What is decided on a Docker host. Sees, waits and does nothing: plain functions over data."""
