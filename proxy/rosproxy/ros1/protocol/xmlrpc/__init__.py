"""XML-RPC as ROS uses it, edited in place: the proxy changes only the necessary bytes."""
