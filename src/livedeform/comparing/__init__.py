"""Put runs side by side: ``livedeform compare``."""
