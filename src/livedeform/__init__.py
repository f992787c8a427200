import os

# nodes and workers share the cores by processes; a thread per core of each library besides makes all of them wait.
# Set before numpy is imported; an OMP_NUM_THREADS of the user's own counts
os.environ.setdefault("OMP_NUM_THREADS", "1")

__version__ = "0.1.0"
