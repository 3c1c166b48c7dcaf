"""A demonstration that needs nothing but Python: two sides, a boundary, and the real proxy.

``python -m rosproxy.demo`` starts an embedded ROS master and small ROS nodes (real XML-RPC, real
TCPROS), each in a process of its own, on two sides of a boundary (see :mod:`.boundary`), with the
real proxy between them; it kills and restarts the proxy in the middle and counts every message.
"""
