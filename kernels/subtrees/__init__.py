"""Complete subtrees of a forest as units of work."""
