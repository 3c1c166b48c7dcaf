"""Routes, interfaces, host names, and signs of the processes of this machine."""
