"""Check scenarios before anything is made of them."""
