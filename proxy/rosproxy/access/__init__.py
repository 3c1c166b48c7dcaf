"""Policy: what outside may see and do, and what inside may take from outside.

`rules` and `layers` are pure and decide. `access_policy` holds the layers in force and reports
denials.
"""
