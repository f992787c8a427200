"""Tell by how the probe meets the body what may be wrong, and what holds the body."""
