"""What is to be done next: for Services, proxies, LAN relays, NetworkPolicies and unwired pods."""
