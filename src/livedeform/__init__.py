import os
from importlib.metadata import PackageNotFoundError, version

# nodes and workers share the cores by processes; a thread per core of each library besides makes all of them wait.
# Set before numpy is imported; an OMP_NUM_THREADS of the user's own counts
os.environ.setdefault("OMP_NUM_THREADS", "1")

try:
    __version__ = version("livedeform")  # from the tag that it was built of
except PackageNotFoundError:  # a source tree that was not installed has none
    __version__ = "unknown"
