"""What is to be installed beside an installed ROS 2 Jazzy, whose messages are built against NumPy 1.

    python .ci/beside_ros.py > needed.txt     then pip install -r needed.txt, and OpenCV with --no-deps

OpenCV asks for NumPy 2; its files run with NumPy 1.26, too, as the other packages' do.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ELSEWHERE = ("ros-", "numpy", "opencv-")


def needed() -> list[str]:
    """Return requirements, in pip's words."""
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
    extras = project["project"]["optional-dependencies"]
    every = [*project["project"]["dependencies"], *extras["fast"], *project["build-system"]["requires"]]
    return [*(r for r in every if not re.match("|".join(ELSEWHERE), r)), "numpy>=1.26,<2"]


if __name__ == "__main__":
    print("\n".join(needed()))
