"""A demonstration that needs nothing but Python: two sides, NAT between them, and the real proxy.

`python -m examples.demo` plays a scenario (:mod:`.scenario`) with a small ROS master and small
nodes that speak real XML-RPC and real TCPROS, and with the proxy as a process of its own, which is
killed and started again in the middle. The master and the nodes (:mod:`.fake_http`,
:mod:`.fake_master`, :mod:`.fake_node`) are also those of the integration tests; what a test may
set on them has no use here.
"""
