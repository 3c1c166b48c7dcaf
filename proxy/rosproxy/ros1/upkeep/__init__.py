"""What happens by the clock rather than by a call: probes, recovery, restoring, cleaning up."""
