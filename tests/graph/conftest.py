"""Every test worker has its own ROS domain, and message fields are checked."""

from __future__ import annotations

import os
import socket
from contextlib import suppress

# before any message package is imported: rclpy serialises wrong types to garbage without a word
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


def free_domain() -> int:
    """A ROS domain of 20 to 99 that nobody on this machine is in: its discovery port (DDSI-RTPS 9.6.1.1) is free."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    for k in range(80):
        domain = 20 + (os.getpid() * 7 + worker + k) % 80
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
            probe.bind(("", 7400 + 250 * domain))
            return domain
    raise RuntimeError("no ROS domain is free")


os.environ["ROS_DOMAIN_ID"] = str(free_domain())

from pathlib import Path  # noqa: E402

import pytest  # noqa: E402
import small  # noqa: E402

from livedeform.common.experiment.yaml_file import load_experiment  # noqa: E402
from livedeform.common.types import Prediction  # noqa: E402
from livedeform.fem_node.model import PhantomModel  # noqa: E402


@pytest.fixture(scope="session")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small experiment's folder."""
    return small.write_experiment(tmp_path_factory.mktemp("small"))


@pytest.fixture(scope="session")
def direct(experiment: Path) -> list[Prediction]:
    """Predictions of the small press by direct calls."""
    model = PhantomModel.from_experiment(load_experiment(experiment))
    return [model.predict(pose) for pose in small.press()]


@pytest.fixture(scope="session")
def bag(experiment: Path, direct: list[Prediction]) -> Path:
    """The press, and markers that are measured at the poses' stamps, off by ``small.OFFSET``."""
    frames = [small.frame(p.stamp_ns, p.ids, p.markers + small.OFFSET) for p in direct]
    return small.write_bag(experiment / "press.mcap", small.press(), frames)


@pytest.fixture(scope="session")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> small.Filmed:
    """Six moments of a press, filmed by two cameras."""
    folder, rig, T_phantom_left = small.write_picture_experiment(tmp_path_factory.mktemp("filmed"))
    model = PhantomModel.from_experiment(load_experiment(folder))
    poses = small.press(6)
    direct = [model.predict(pose) for pose in poses]
    pairs = [small.pictures(rig, T_phantom_left, p, seed) for seed, p in enumerate(direct)]
    return small.Filmed(folder, small.write_picture_bag(folder / "film.mcap", poses, pairs), direct, pairs)
