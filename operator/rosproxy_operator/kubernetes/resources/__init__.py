"""The objects of the cluster: the operator's model, and readers of the API server's JSON. Pure."""
