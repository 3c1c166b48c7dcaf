"""A demonstration that needs only Python: two sides with NAT between, and the real proxy.

`python -m examples.demo` plays a scenario (:mod:`.scenario`) with a small ROS master, small ROS 1
nodes that speak real XML-RPC and TCPROS, and small ROS 2 nodes that speak real RTPS
(:mod:`.ros2_acts`). The proxy is a separate process. The scenario kills and restarts this process
in the middle. The integration tests use the same master and ROS 1 nodes (:mod:`.fake_http`,
:mod:`.fake_master`, :mod:`.fake_node`), and some attributes are only for tests.

The ROS 2 nodes (:mod:`.fake_participant`) use no DDS library. A library cannot stay at 127.0.2.11
alone and reject datagrams from 127.0.1.0/24, and users would have to install it.
"""
