"""Users' pods: which pods a RosProxy selects, how the webhook wires pods, and faults of pods."""
