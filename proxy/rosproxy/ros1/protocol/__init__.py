"""What ROS 1 speaks: XML-RPC documents, TCPROS headers, URIs, the master's methods. Pure."""
