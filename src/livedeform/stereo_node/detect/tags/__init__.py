"""Square tags: their middles by the picture of their whole code."""
