"""Controllers that provide containers and pods with a proxy of their own."""
