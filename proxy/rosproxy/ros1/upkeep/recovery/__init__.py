"""After a start: endpoints and leases rebuilt from what the master holds."""
