"""Read the labels of containers, and decide which proxy each container gets."""
