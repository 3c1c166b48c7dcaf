"""The protocols of ROS 1: XML-RPC documents, TCPROS headers, URIs, the master's methods. Pure."""
