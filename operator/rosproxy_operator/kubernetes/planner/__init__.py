"""The decisions for a Kubernetes cluster: plain functions over data, as on a Docker host."""
