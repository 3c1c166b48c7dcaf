"""Connections that the kernel forwards: netfilter rules kept in step with the leases."""
