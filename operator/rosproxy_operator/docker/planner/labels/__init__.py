"""From the labels of containers to what they want of a proxy."""
