"""The steps of a plan: actions for Services, proxies, LAN relays, NetworkPolicies and pods."""
