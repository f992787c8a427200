"""The solver behind the synthetic truth: hexahedra, its own contact and time integration; nothing of ``fem_node``."""
