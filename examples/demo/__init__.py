"""A demonstration that needs nothing but Python: two sides, NAT between them, and the real proxy.

`python -m examples.demo` plays a scenario (:mod:`.scenario`) with a small ROS master and small
nodes that speak real XML-RPC and real TCPROS, with nodes of ROS 2 that speak real RTPS
(:mod:`.ros2_acts`), and with the proxy as a process of its own, which is killed and started again
in the middle. The master and the nodes of ROS 1 (:mod:`.fake_http`, :mod:`.fake_master`,
:mod:`.fake_node`) are also those of the integration tests; what a test may set on them has no use
here.

The nodes of ROS 2 are small ones of its own (:mod:`.fake_participant`) and no library's: a DDS
can't be told to live at 127.0.2.11 alone and to turn away what comes from 127.0.1.0/24, and would
be the one thing to install.
"""
