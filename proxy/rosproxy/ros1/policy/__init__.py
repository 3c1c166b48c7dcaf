"""The policy for ROS 1: what nodes inside and outside may do with topics, services and parameters.

`rosproxy.access` has the rules. `checks` applies the rules: before the master or a node is called,
at a TCPROS header, and to what comes back. A registration that a rule denies is *hidden*: the proxy
keeps the registration from the master, and `hidden` answers nodes inside in the master's place.
`rosproxy.ros1.upkeep.policy_enforcer` makes registrations and connections fit a policy that has
changed.
"""
