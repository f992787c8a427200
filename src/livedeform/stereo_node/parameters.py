"""Parameters of stereo_node."""

from __future__ import annotations

from dataclasses import dataclass

from livedeform.common.node_parameters import LATEST_NS, within


@dataclass(frozen=True)
class StereoParameters:
    """ROS parameters.

    ``experiment``: folder or YAML file. ``source``: "pictures", or "markers" that another tracker measured and that are
    only corrected. ``rest_markers``: CSV file (id,x,y,z in m) of the markers at rest, where that is not what the
    experiment declares. ``camera_pose``: T_phantom_left as "x y z qx qy qz qw" for source "markers".
    ``pair_tolerance``: s between left and right picture, beyond their offset, but at most 0.4 of the cameras' period.
    ``pair_offset``: s by which the right camera's stamps are later although it looks at the same moment.
    ``best_effort``: hear cameras that are not reliable. ``start_ns``: the recording's start (0: the first stamp).
    ``model_prior``: look for markers that come back where ``/fem/markers`` predicts them, as far as the markers that
    are seen agree. ``model_prior_age``: s by which that prediction may be older or newer than the pictures.
    """

    experiment: str = ""
    source: str = "pictures"
    rest_markers: str = ""
    camera_pose: str = ""
    pair_tolerance: float = within(0.005, 0.0, 1.0)
    pair_offset: float = within(0.0, -10.0, 10.0)
    best_effort: bool = True
    start_ns: int = within(0, 0, LATEST_NS)
    model_prior: bool = False
    model_prior_age: float = within(0.2, 0.0, 10.0)
