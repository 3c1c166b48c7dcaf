"""The wire formats of DDS (OMG DDSI-RTPS 2.5): read, and edited in place."""
