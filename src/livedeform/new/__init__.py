"""Make an experiment of one's own surface and markers: ``livedeform new``."""
