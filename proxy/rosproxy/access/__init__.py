"""Policy: what outside may see and do, and what inside may take from outside.

`rules` and `layers` are pure and decide; `access_policy` holds what is in force, and tells of what
it denies.
"""
