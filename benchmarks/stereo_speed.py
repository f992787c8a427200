"""Pairs per second of the stereo tracker at 1280 x 720 with 60 markers, against OpenCV's SimpleBlobDetector alone, on
the same pictures.

    python benchmarks/stereo_speed.py [--frames 40]

CPU seconds of one thread (other work on the machine does not count); the median and the fastest of the frames.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[name] = "1"

import cv2  # noqa: E402
import numpy as np  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "stereo_node"))
from scene import Look, dome_markers, looking_down, make_test_rig, render  # noqa: E402

from livedeform.common.types import Image  # noqa: E402
from livedeform.stereo_node.pipeline import StereoTracker  # noqa: E402


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=40)
    n_frames = parser.parse_args().frames
    cv2.setNumThreads(1)
    rig, (markers, normals), T = make_test_rig(), dome_markers(60, height=0.03, spacing=0.008), looking_down(tilt=0.1)
    rng = np.random.default_rng(0)
    clean = [
        render(rig, T, markers.points, normals, Look(noise=0), rng, side, rounded=False) for side in ("left", "right")
    ]
    tracker, blob = StereoTracker(rig, markers), cv2.SimpleBlobDetector_create()
    ours, theirs, found, seen = [], [], [], 0
    for k in range(n_frames):
        pair = [np.clip(np.round(c + rng.normal(0, 2, c.shape)), 0, 255).astype(np.uint8) for c in clean]
        start = time.process_time()
        frame, _ = tracker.process(Image(k + 1, pair[0]), Image(k + 1, pair[1]))
        ours.append(time.process_time() - start)
        start = time.process_time()
        keys = [blob.detect(p) for p in pair]
        theirs.append(time.process_time() - start)
        found.append(len(frame.ids))
        seen += sum(len(x) for x in keys)
    ours, theirs = ours[3:], theirs[3:]  # the first frames compile, register and learn
    print("                                  CPU ms per pair (median, least)   pairs/s   markers")
    for name, times, count in (
        ("stereo tracker, all of it", ours, np.mean(found)),
        ("2 x SimpleBlobDetector.detect", theirs, seen / 2 / n_frames),
    ):
        median, least = 1e3 * np.median(times), 1e3 * min(times)
        print(f"{name:34}{median:8.1f} {least:8.1f} {1e3 / median:20.1f} {count:9.1f}")
    print(f"ratio of medians: {np.median(theirs) / np.median(ours):.2f}")


if __name__ == "__main__":
    main()
