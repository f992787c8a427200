"""Makes the files of the tutorial: a press that the solver of the synthetic experiments computes, as the plain tables
that a tracker and a robot export.

livedeform synth examples/own_data/truth.yaml --out out/truth
python examples/own_data/make_data.py out/truth examples/own_data
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import trimesh

from livedeform.common.bags.recording import load_recording
from livedeform.common.experiment.yaml_file import load_experiment

MM = 1e3
SIZE = (50.0, 50.0, 70.0)  # mm
PRESSES = {"a": "monday", "b": "tuesday"}


def write_table(path: Path, header: str, rows: list[list[str]]) -> None:
    """One CSV file."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header.split(","))
        writer.writerows(rows)


def main(source: Path, out: Path) -> None:
    """Surface and markers in millimetres; one table of tracked points and one of probe poses per recording."""
    block = trimesh.creation.box(SIZE)
    block.apply_translation((0.0, 0.0, SIZE[2] / 2))
    block.export(out / "block.stl")
    markers = load_experiment(source / "experiment").markers
    rows = [[str(i), *(f"{MM * x:.2f}" for x in point)] for i, point in zip(markers.ids, markers.points, strict=True)]
    write_table(out / "markers.csv", "id,x,y,z", rows)
    for name, day in PRESSES.items():
        recording = load_recording(source / "bags" / name)
        frames, poses = recording.marker_frames, recording.poses
        start = min(frames[0].stamp_ns, poses[0].stamp_ns)
        points = [
            [f"{(frame.stamp_ns - start) * 1e-9:.4f}", str(i), *(f"{MM * x:.3f}" for x in point)]
            for frame in frames
            for i, point in zip(frame.ids, frame.points, strict=True)
        ]
        write_table(out / f"{day}_points.csv", "seconds,id,x,y,z", points)
        places = [
            [f"{(p.stamp_ns - start) * 1e-9:.4f}", *(f"{MM * x:.3f}" for x in p.position)]
            + [f"{q:.6f}" for q in p.orientation_xyzw]
            for p in poses
        ]
        write_table(out / f"{day}_probe.csv", "seconds,x,y,z,qx,qy,qz,qw", places)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
