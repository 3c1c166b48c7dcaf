"""Users' pods: whom a RosProxy selects, how they are wired, and what they can't have."""
