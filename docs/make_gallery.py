"""Makes the ten reports of docs/gallery.md, their pictures, and what the page quotes of them.

python docs/make_gallery.py out/gallery          (about a quarter of an hour; needs Chromium and playwright)
python docs/make_gallery.py out/gallery --only clock_late

The recordings are the shipped phantom's, as the tracker measured them, with one thing changed in each.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Browser, sync_playwright

from livedeform.cli import run as livedeform
from livedeform.common.bags.recording import load_recording
from livedeform.common.types import Array
from livedeform.recording import Writer
from livedeform.shipped import BREAST, shipped

HERE = Path(__file__).parent
PAGE, PICTURES = HERE / "gallery.md", HERE / "img" / "gallery"
SIZE = (1100, 620)  # of a picture, px
THRESHOLD = 0.0001  # m; the shipped 5 mm could not be failed by a press of 5 mm


@dataclass(frozen=True)
class Take:
    """A recording as arrays: ``seconds`` (n,), ``points`` (n, markers, 3) m with NaN for what was not seen, ``poses``
    (p, 8): s, m, quaternion."""

    seconds: Array
    ids: Array
    points: Array
    sigma: Array
    poses: Array

    def write(self, path: Path) -> None:
        """Write it as a recording."""
        with Writer(path, begins="2026-03-02 10:30") as recording:
            for second, points, sigma in zip(self.seconds, self.points, self.sigma, strict=True):
                seen = np.isfinite(points).all(axis=1)
                recording.points(second, self.ids[seen], points[seen], covariances=sigma[seen])
            for pose in self.poses:
                recording.pose(pose[0], pose[1:4], pose[4:])


def take(run_mcap: Path) -> Take:
    """What a run's tracker measured, and the probe's poses."""
    recording = load_recording(run_mcap)
    frames, poses = recording.marker_frames, recording.poses
    start = min(frames[0].stamp_ns, poses[0].stamp_ns)
    ids = np.unique(np.concatenate([f.ids for f in frames]))
    points, sigma = np.full((len(frames), len(ids), 3), np.nan), np.zeros((len(frames), len(ids), 3, 3))
    for k, frame in enumerate(frames):
        where = np.searchsorted(ids, frame.ids)
        points[k, where], sigma[k, where] = frame.points, frame.covariances
    seconds = np.array([(f.stamp_ns - start) * 1e-9 for f in frames])
    rows = [[(p.stamp_ns - start) * 1e-9, *p.position, *p.orientation_xyzw] for p in poses]
    return Take(seconds, ids, points, sigma, np.array(rows))


def late(original: Take, by: float = 0.3) -> Take:
    """The tracker's clock is late by so many seconds."""
    return replace(original, seconds=original.seconds + by)


def beside(original: Take, by: float = 0.012) -> Take:
    """The probe's pose is reported so many metres beside where it is."""
    poses = original.poses.copy()
    poses[:, 1] += by
    return replace(original, poses=poses)


def hidden(original: Take, share: float = 0.7) -> Take:
    """All but two markers are hidden in this share of the frames, those of the deepest press among them."""
    points = original.points.copy()
    n = len(points)
    first = int((1 - share) / 2 * n)
    points[first : first + int(share * n), 2:] = np.nan
    return replace(original, points=points)


def bumped(original: Take, by: float = 0.0005) -> Take:
    """Somebody pushes the camera in the middle: from then on everything is measured so many metres beside."""
    points = original.points.copy()
    points[len(points) // 2 :, :, 0] += by
    return replace(original, points=points)


def wandering(original: Take, size: float = 0.0006) -> Take:
    """Markers come off: a third of them creep over the surface, each its own way (metres in the end)."""
    points = original.points.copy()
    rng = np.random.default_rng(2)
    ways = rng.normal(size=(points.shape[1], 3))
    ways[rng.permutation(len(ways))[len(ways) // 3 :]] = 0.0
    time = np.linspace(0.0, 1.0, len(points))[:, None, None]
    return replace(original, points=points + size * np.sqrt(time) * ways)


def poor(original: Take, sigma: float = 0.0005) -> Take:
    """A poor tracker, which says so: noise of so many metres in each coordinate."""
    rng = np.random.default_rng(3)
    noise = rng.normal(0.0, sigma, original.points.shape)
    return replace(original, points=original.points + noise, sigma=original.sigma + sigma**2 * np.eye(3))


def same(original: Take) -> Take:
    """The recording as it was measured."""
    return original


@dataclass(frozen=True)
class Item:
    """One report: what was changed in the recordings, and with which model they are run or diagnosed."""

    name: str
    change: Callable[[Take], Take]
    model: str  # "declared" (its base does not slip; the true one does) or "fitted"
    command: str  # "run" or "diagnose"


ITEMS = (
    Item("right", same, "fitted", "run"),
    Item("base", same, "declared", "run"),
    Item("clock_late", late, "fitted", "run"),
    Item("beside", beside, "fitted", "run"),
    Item("bumped", bumped, "fitted", "run"),
    Item("hidden", hidden, "fitted", "run"),
    Item("effect", same, "declared", "diagnose"),
    Item("nothing", same, "fitted", "diagnose"),
    Item("unexplained", wandering, "fitted", "diagnose"),
    Item("two", poor, "declared", "diagnose"),
)


class Gallery:
    """The folder in which experiments, recordings and reports are made."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.source = shipped(BREAST)
        self.models = {"declared": out / "declared", "fitted": out / "fitted"}

    def prepare(self) -> None:
        """The declared model with a threshold that can be failed, and the fitted model."""
        declared = self.models["declared"]
        if not declared.exists():
            shutil.copytree(self.source / "experiment", declared)
            text = (declared / "experiment.yaml").read_text()
            (declared / "experiment.yaml").write_text(
                re.sub(r"(thresholds: \{error: )[\d.]+", rf"\g<1>{THRESHOLD}", text)
            )
        if not self.models["fitted"].exists():
            self.make(next(item for item in ITEMS if item.name == "effect"))
            shutil.copytree(declared, self.models["fitted"])
            shutil.copy(self.out / "effect" / "experiment.fitted.yaml", self.models["fitted"] / "experiment.yaml")

    def recording(self, item: Item, name: str) -> Path:
        """The changed recording a or b of an item."""
        path = self.out / f"{item.name}_{name}.mcap"
        if not path.exists():
            item.change(take(self.measured(item.model, name))).write(path)
        return path

    def measured(self, model: str, name: str) -> Path:
        """Recording a or b as the tracker measured it, whose cameras are registered to a model at rest."""
        out = self.out / f"measured_{model}_{name}"
        if not out.exists():
            call("run", self.models[model], "--bag", self.source / "bags" / name, "--at-frames", "--out", out)
        return out / "run.mcap"

    def make(self, item: Item) -> None:
        """The item's report, unless it is there."""
        out = self.out / item.name
        if (out / "report.html").exists():
            return
        b = self.recording(item, "b")
        if item.command == "run":
            call("run", self.models[item.model], "--bag", b, "--at-frames", "--out", out)
        else:
            call("diagnose", self.models[item.model], "--fit", self.recording(item, "a"), "--test", b, "--out", out)


def call(*words: object) -> None:
    """One command of livedeform; what it judges may be bad."""
    code = livedeform([str(word) for word in words])
    if code not in (0, 1):
        raise SystemExit(f"livedeform {' '.join(map(str, words))}: exit code {code}")


def picture(browser: Browser, report: Path, target: Path) -> None:
    """The top of a page, as a reader of it sees it first."""
    tab = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]}, color_scheme="light")
    tab.goto(report.resolve().as_uri())
    tab.wait_for_timeout(6000)  # charts
    target.parent.mkdir(exist_ok=True)
    png = target.with_suffix(".png")
    tab.screenshot(path=png)
    tab.close()
    Image.open(png).convert("RGB").save(target, quality=80, method=6)
    png.unlink()


def quoted(folder: Path) -> str:
    """The verdict and its sentence, as the report has them."""
    (document,) = [folder / name for name in ("diagnosis.json", "metrics.json") if (folder / name).exists()]
    judged = json.loads(document.read_text())
    parts = [f"**{judged['verdict']}.**"]
    for effect in judged.get("effects", []):
        values = [f"{name} {v['value']:.4g} ± {v['sigma']:.2g}" for name, v in effect["parameters"].items()]
        parts.append(f"`{effect['name']}`: {', '.join(values)}.")
    return " ".join([*parts, judged.get("reason") or judged["unexplained"]])


def main() -> None:
    """Make what is missing, the pictures, and the quotations of the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", help="one report, without a picture")
    arguments = parser.parse_args()
    gallery = Gallery(arguments.out)
    gallery.prepare()
    for item in ITEMS:
        if arguments.only in (None, item.name):
            gallery.make(item)
    if arguments.only:
        return
    page = PAGE.read_text()
    with sync_playwright() as play:
        browser = play.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", "--use-gl=swiftshader"]
        )
        for item in ITEMS:
            picture(browser, gallery.out / item.name / "report.html", PICTURES / f"{item.name}.webp")
            begin, end = f"<!-- {item.name} says -->", "<!-- end -->"
            head, rest = page.split(begin)
            page = head + begin + "\n\n> " + quoted(gallery.out / item.name) + "\n\n" + end + rest.split(end, 1)[1]
        browser.close()
    PAGE.write_text(page)


if __name__ == "__main__":
    main()
