"""Sizes of buffers of sockets."""

UDP_RECEIVE_BUFFER_BYTES = 1024 * 1024
"""Bytes that wait at a UDP port while the event loop is busy.

Without NET_ADMIN, Linux grants at most net.core.rmem_max.
"""
