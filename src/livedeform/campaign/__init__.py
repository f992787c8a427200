"""Many recordings, each one job of one core, in one table and one page; and what they have in common."""
