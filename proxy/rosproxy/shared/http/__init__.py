"""HTTP for admin endpoints: the server, the rule for hosts, replies, bodies, and the client."""
