"""The kernel plane: netfilter rules for connections and datagrams, kept in step with the ports."""
