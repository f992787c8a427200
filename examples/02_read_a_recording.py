"""What a recording holds, as numpy arrays, without ROS: the shipped gelatin cuboid."""

import numpy as np

from livedeform.common.bags.recording import load_recording
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.shipped import CUBOID, shipped

folder = shipped(CUBOID)
experiment = load_experiment(folder / "experiment")
recording = load_recording(folder / "bags" / "a", experiment)

seconds = (recording.end_ns - recording.start_ns) * 1e-9
n_frames, n_poses = len(recording.marker_frames), len(recording.poses)
print(f"{experiment.name}: {n_frames} marker frames and {n_poses} poses in {seconds:.1f} s")

frame = recording.marker_frames[0]
sigma = np.sqrt(np.trace(frame.covariances, axis1=1, axis2=2))
print(f"first frame: {len(frame.ids)} of {len(experiment.markers.ids)} markers, sigma {1e3 * np.median(sigma):.2f} mm")

assert n_frames > 50 and n_poses > 100
assert set(frame.ids) <= set(experiment.markers.ids)
assert not recording.warnings
