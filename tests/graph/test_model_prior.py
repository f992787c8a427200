"""The model's prediction as a prior of the stereo node: off unless asked for, and told by /fem/markers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small
from diagnostic_msgs.msg import DiagnosticArray
from small import Filmed

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.frames import apply, inverse
from livedeform.common.ros.node import CountingNode
from livedeform.common.ros.session import ros
from livedeform.common.types import Image, PredictedMarkers
from livedeform.fem_node.node import FemNode
from livedeform.run import replay
from livedeform.run.graph import Graph, Player, play_in_lock_step
from livedeform.run.running import isolated
from livedeform.stereo_node.camera.calibration_file import read_camera
from livedeform.stereo_node.camera.rig import StereoRig
from livedeform.stereo_node.node import StereoNode
from livedeform.stereo_node.track.model_prior import ModelPrior

HIDDEN = 3  # row of the marker that is covered in the third and fourth pair


class Listener(CountingNode):
    """Keeps what the stereo node says of every pair."""

    def __init__(self) -> None:
        super().__init__("listener")
        self.said: list[dict[str, str]] = []
        self.subscribe(DiagnosticArray, t.STEREO_STATUS, self.hear)

    def hear(self, message: DiagnosticArray) -> None:
        self.said.append({pair.key: pair.value for pair in message.status[0].values})


@pytest.fixture(scope="module")
def bag(filmed: Filmed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The film, with one marker covered in two pairs."""
    stereo = load_experiment(filmed.folder).stereo
    assert stereo is not None and stereo.left is not None and stereo.right is not None
    rig = StereoRig(read_camera(stereo.left), read_camera(stereo.right))
    to_left = inverse(small.write_picture_experiment(tmp_path_factory.mktemp("again"))[2])

    def covered(k: int, pair: tuple[Image, Image]) -> Iterator[Image]:
        for image, pixel in zip(pair, rig.project(apply(to_left, filmed.direct[k].markers))[:2], strict=True):
            pixels = image.pixels.copy()
            u, v = np.round(pixel[HIDDEN]).astype(int)
            pixels[v - 9 : v + 10, u - 9 : u + 10] = np.median(pixels)
            yield replace(image, pixels=pixels)

    pairs = [tuple(covered(k, p)) if k in (2, 3) else p for k, p in enumerate(filmed.pairs)]
    return small.write_picture_bag(tmp_path_factory.mktemp("covered") / "film.mcap", small.press(6), pairs)


@pytest.mark.parametrize("asked", [False, True])
def test_a_covered_marker_is_looked_for_where_the_model_puts_it(filmed: Filmed, bag: Path, asked: bool):
    experiment = load_experiment(filmed.folder)
    common = {"experiment": str(filmed.folder), "best_effort": False}
    with read_bag(bag) as read, isolated(True), ros([]) as stop:
        plan = replay.plan(read, experiment)
        fem = FemNode(common | {"trigger": "poses", "newest_only": False}, lambda *_: None)
        stereo = StereoNode(common | ({"model_prior": True} if asked else {}))
        listener, player = Listener(), Player(sorted(set(plan.topics.values())))
        with Graph([fem, stereo, listener, player], stop) as graph:
            graph.start()
            for _ in play_in_lock_step(graph, player, replay.messages(read, plan)):
                pass
    assert len(listener.said) == 6
    used = [int(said["n_by_model"]) for said in listener.said]
    assert used[3] == used[4] == int(asked)  # not seen in the pair before
    assert [int(said["n_identified"]) for said in listener.said] == [24, 24, 23, 23, 24, 24]


def test_a_prediction_counts_near_its_moment_and_where_it_is_finite():
    prior = ModelPrior(np.array([7, 8, 9], np.uint32), 100)
    assert prior.at(0) is None
    prior.add(
        PredictedMarkers(1000, np.array([9, 7, 5], np.uint32), np.array([[1.0, 2, 3], [np.nan, 0, 0], [4, 5, 6]]))
    )
    prior.add(PredictedMarkers(1300, np.array([8], np.uint32), np.array([[7.0, 8, 9]])))
    assert prior.at(800) is None and prior.at(1401) is None
    np.testing.assert_array_equal(prior.at(1100), [[np.nan] * 3, [np.nan] * 3, [1, 2, 3]])
    np.testing.assert_array_equal(prior.at(1200), [[np.nan] * 3, [7, 8, 9], [np.nan] * 3])
