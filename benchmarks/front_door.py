"""Figures of the front door: words per page, links, steps of the tutorial, panels of the layouts that have data.

python -m benchmarks.front_door [--run out/run]
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from livedeform.common.bags.read import read_bag
from livedeform.report.layouts import foxglove_layout, rviz_layout, topics_of_panel

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def words() -> list[tuple[str, int]]:
    """Words of every page, code and tables among them."""
    return [(str(path.relative_to(ROOT)), len(path.read_text().split())) for path in sorted(DOCS.rglob("*.md"))]


def broken_links() -> tuple[int, list[str]]:
    """How many links between files there are, and those that lead nowhere."""
    n, broken = 0, []
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]:
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
            if target.startswith(("http://", "https://")):
                continue
            n += 1
            if not (page.parent / target).exists():
                broken.append(f"{page.relative_to(ROOT)}: {target}")
    return n, broken


def tutorial_steps() -> int:
    """The commands that a reader of the tutorial types."""
    page = (DOCS / "tutorial" / "own-data.md").read_text()
    return len(re.findall(r"^\$ ", page, re.M))


def panels(run: Path) -> list[tuple[str, int, int]]:
    """Viewer, panels with data, panels."""
    with read_bag(run / "run.mcap") as bag:
        there = {name for name, info in bag.topics.items() if info.count}
    foxglove = foxglove_layout(there)["configById"].values()
    alive = sum(bool(topics_of_panel(panel) & there) for panel in foxglove)
    displays = [d for d in rviz_layout(there)["Visualization Manager"]["Displays"] if "Topic" in d]
    return [("foxglove", alive, len(foxglove)), ("rviz", len(displays), len(displays))]


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, help="a run's folder, for the panels")
    run = parser.parse_args().run
    for page, n in words():
        print(f"{n:6d} words  {page}")
    n, broken = broken_links()
    print(f"links between files: {n}, broken: {len(broken)} {' '.join(broken)}")
    print(f"commands of the tutorial: {tutorial_steps()}")
    for viewer, alive, all_ in panels(run) if run else ():
        print(f"{viewer}: {alive} of {all_} panels have data")


if __name__ == "__main__":
    main()
