"""The policy on rmw_zenoh: rules become the access control of a container's router. All pure."""
