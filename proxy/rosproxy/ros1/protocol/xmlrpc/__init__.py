"""XML-RPC as ROS uses it, edited in place: every byte that need not change stays."""
