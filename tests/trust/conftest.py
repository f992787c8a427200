"""The small experiment of the graph's tests, and situations in which a number must not be trusted."""

from __future__ import annotations

import sys
from pathlib import Path

for folder in ("graph", "trust"):
    sys.path.insert(0, str(Path(__file__).parents[1] / folder))
