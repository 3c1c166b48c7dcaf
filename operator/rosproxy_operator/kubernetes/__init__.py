"""The operator for a Kubernetes cluster: thin adapters around the planner."""
