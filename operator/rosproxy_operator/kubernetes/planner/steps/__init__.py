"""What is to be done next: for Services, proxies, ears, NetworkPolicies and unwired pods."""
