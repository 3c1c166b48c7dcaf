"""What a RosProxy's owner is told: conditions, findings, status, Events. Pure."""
