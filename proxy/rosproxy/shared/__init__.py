"""What the operator and the proxy share. Nothing here imports another room of the proxy.

The operator writes the settings of a proxy, sends policy and containers, and reads the status. So
both programs need the same settings, rules and documents. Both also have an admin endpoint, and
write logs and findings.
"""
