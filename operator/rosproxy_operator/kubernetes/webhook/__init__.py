"""The admission webhook, which wires new pods to the proxy of the node."""
