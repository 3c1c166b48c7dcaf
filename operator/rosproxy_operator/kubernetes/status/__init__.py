"""What users read about a RosProxy: conditions, findings, status, Events. Pure."""
