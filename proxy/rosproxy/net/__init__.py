"""HTTP for XML-RPC, changes of networks, and the signs of proxies."""
