"""Parameters of fem_node."""

from __future__ import annotations

from dataclasses import dataclass

from livedeform.common.node_parameters import LATEST_NS, within


@dataclass(frozen=True)
class Parameters:
    """ROS parameters. ``experiment``: folder or YAML file. ``trigger``: predict at every one of "poses", or at the
    measured "frames" (poses interpolated), or there with "no_poses" (auto: by the experiment). ``newest_only``: skip
    poses that come faster than the model solves. ``best_effort``: hear unreliable publishers. ``start_ns``: the start
    (0: the first stamp). ``rest_first``: publish the surface at rest first. ``mesh_period``: s between ``/fem/mesh``.
    ``expected``: bag of poses to prepare for. ``after``: bags (apart by ":") of what the body went through before.
    ``raw_first``: measured frames are those of ``/stereo/markers_raw``, whose correction waits for the surface."""

    experiment: str = ""
    trigger: str = "auto"
    newest_only: bool = True
    best_effort: bool = True
    start_ns: int = within(0, 0, LATEST_NS)
    rest_first: bool = False
    mesh_period: float = within(0.1, 0.0, 3600.0)
    expected: str = ""
    after: str = ""
    raw_first: bool = False
