"""Making and taking back registrations at the master on behalf of nodes."""
