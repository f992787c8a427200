"""Parameters of stereo_node, and what is made of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from livedeform.common.experiment.markers_file import read_markers
from livedeform.common.experiment.schema import Experiment
from livedeform.common.node_parameters import LATEST_NS, within
from livedeform.common.types import Array, Ids
from livedeform.stereo_node.correction import MeasuringCorrection, parse_pose
from livedeform.stereo_node.pairing import PicturePairs
from livedeform.stereo_node.track.model_prior import ModelPrior


@dataclass(frozen=True)
class StereoParameters:
    """ROS parameters.

    ``experiment``: folder or YAML file. ``source``: "pictures", or "markers" that another tracker measured and that are
    only corrected. ``rest_markers``: CSV file (id,x,y,z in m) of the markers at rest, where that is not what the
    experiment declares. ``camera_pose``: T_phantom_left as "x y z qx qy qz qw" for source "markers".
    ``pair_tolerance``: s between left and right picture, beyond their offset, but at most 0.4 of the cameras' period.
    ``pair_offset``: s by which the right camera's stamps are later although it looks at the same moment.
    ``lone_after``: s without another picture after which the first of each camera are a pair, although their period
    does not show yet; 0: never. ``best_effort``: hear cameras that are not reliable.
    ``start_ns``: the recording's start (0: the first stamp).
    ``model_prior``: look for markers that come back where ``/fem/markers`` predicts them, as far as the markers that
    are seen agree. ``model_prior_age``: s by which that prediction may be older or newer than the pictures.
    ``surface_wait``: s that a frame waits for the surface that is predicted at its moment, where a refraction is
    corrected. Without a probe none waits, as predictions follow the corrected frames; save with ``raw_first``:
    ``fem_node`` predicts at frames before they are corrected. Without that it is to be 0 where predictions follow.
    """

    experiment: str = ""
    source: str = "pictures"
    rest_markers: str = ""
    camera_pose: str = ""
    pair_tolerance: float = within(0.005, 0.0, 1.0)
    pair_offset: float = within(0.0, -10.0, 10.0)
    lone_after: float = within(1.0, 0.0, 3600.0)
    best_effort: bool = True
    start_ns: int = within(0, 0, LATEST_NS)
    model_prior: bool = False
    model_prior_age: float = within(0.2, 0.0, 10.0)
    surface_wait: float = within(0.5, 0.0, 10.0)
    raw_first: bool = False

    def picture_pairs(self) -> PicturePairs:
        """Return what pairs the pictures."""
        return PicturePairs(round(self.pair_tolerance * 1e9), expected_ns=round(self.pair_offset * 1e9))

    def rest(self) -> Array | None:
        """Return the markers at rest (n, 3) m; None where they are as the experiment declares them."""
        return read_markers(Path(self.rest_markers)).points if self.rest_markers else None

    def correction(self, experiment: Experiment, rest: Array | None) -> MeasuringCorrection:
        """Return what takes the experiment's measuring effects out of markers that are at ``rest`` (n, 3) m."""
        wait = 0.0 if experiment.probe is None and not self.raw_first else self.surface_wait
        return MeasuringCorrection(experiment, self.start_ns, parse_pose(self.camera_pose), rest, wait)

    def prior(self, ids: Ids) -> ModelPrior:
        """Return what keeps the predictions of the markers ``ids``."""
        return ModelPrior(ids, round(self.model_prior_age * 1e9))
