import os

# nodes and workers share the cores by processes; each library starting a thread per core besides makes all of them wait.
# Before numpy is imported; an OMP_NUM_THREADS of the user's own counts
os.environ.setdefault("OMP_NUM_THREADS", "1")

__version__ = "0.1.0"
