"""Who may do what: what RosProxies may ask for, who calls a proxy, and the rules of its traffic."""
