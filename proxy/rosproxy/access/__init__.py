"""Policy: what outside may see and do, and what inside may take from outside.

`rosproxy.shared.policy` decides. `access_policy` holds the layers in force and reports denials.
"""
