"""Wrong situations: inputs about which the tool must say "wrong" or "doubtful", each made anew in a folder of its own.

A situation changes a sound experiment, or a sound recording of it; `judged` says what the tool says: "refused",
"warned" or "silently wrong". The unchanged ones must be accepted.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parents[1] / "graph"))  # the small experiment of the graph's tests

import small

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.types import encode, message_class
from livedeform.common.bags.write import BagWriter
from livedeform.common.checks.recorded import load_checked
from livedeform.common.errors import InputError
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import MarkerFrame, Pose
from livedeform.inspection import fit_findings

N = 40
YEAR_NS = 365 * 86_400_000_000_000


@dataclass
class Case:
    """A sound experiment and recording, to be spoilt: ``document`` is experiment.yaml, ``markers`` markers.csv, frames
    and poses what is recorded, with the receive times where they are not the stamps, and ``frame_id``."""

    folder: Path
    document: dict[str, Any]
    markers: str
    frames: list[MarkerFrame]
    poses: list[Pose]
    frame_id: str = t.FRAME_PHANTOM
    with_ids: bool = True
    extra: list[tuple[str, str, bytes]] = field(default_factory=list)

    @property
    def experiment(self) -> Path:
        return self.folder

    def write(self) -> Path:
        """Writes both; gives the bag."""
        (self.folder / "experiment.yaml").write_text(yaml.safe_dump(self.document))
        (self.folder / "markers.csv").write_text(self.markers)
        bag = self.folder / "press.mcap"
        with BagWriter(bag, {"made_by": "tests"}) as writer:
            recording = RecordingWriter(writer)
            for k in range(max(len(self.frames), len(self.poses))):
                if k < len(self.frames):
                    self._frame(recording, self.frames[k])
                if k < len(self.poses):
                    recording.pose(self.poses[k])
            for topic, kind, data in self.extra:
                writer.write(topic, kind, small.START_NS, data)
        return bag

    def _frame(self, recording: RecordingWriter, frame: MarkerFrame) -> None:
        if self.with_ids:
            recording.marker_frame(frame, self.frame_id)
            return
        field_class = message_class("sensor_msgs/msg/PointField")
        rows = frame.points.astype("<f4")
        time = message_class("builtin_interfaces/msg/Time")(*divmod(frame.stamp_ns, 1_000_000_000))
        cloud = message_class(t.POINT_CLOUD)(
            header=message_class("std_msgs/msg/Header")(time, self.frame_id), height=1, width=len(rows),
            fields=[field_class(name, 4 * i, 7, 1) for i, name in enumerate("xyz")], is_bigendian=False,
            point_step=12, row_step=rows.nbytes, data=np.frombuffer(rows.tobytes(), np.uint8), is_dense=True,
        )  # fmt: skip
        recording.bag.write(t.STEREO_MARKERS, t.POINT_CLOUD, frame.stamp_ns, encode(cloud))


def sound(folder: Path) -> Case:
    """A press of 3 mm on the small block, and markers that go with it by up to 1 mm."""
    small.write_experiment(folder)
    places, ids = np.array(small.MARKERS), np.arange(1, len(small.MARKERS) + 1, dtype=np.uint32)
    poses = small.press(N)
    lowest = np.array([min(pose.position[2] - small.SIZE[2], 0.0) for pose in poses])
    frames = [
        small.frame(pose.stamp_ns, ids, places + np.outer(places[:, 2] / small.SIZE[2], [0.0, 0.0, low / 3]))
        for pose, low in zip(poses, lowest, strict=True)
    ]
    document = yaml.safe_load((folder / "experiment.yaml").read_text())
    return Case(folder, document, (folder / "markers.csv").read_text(), frames, poses)


Change = Callable[[Case], None]


def effect(name: str, **values: object) -> Change:
    """Declares an effect."""
    return lambda case: case.document.update(effects=[{"name": name, **values}])


def key(path: str, value: object) -> Change:
    """Sets a key of experiment.yaml, given with dots."""

    def change(case: Case) -> None:
        *parents, last = path.split(".")
        section = case.document
        for parent in parents:
            section = section.setdefault(parent, {})
        section[last] = value

    return change


def renamed(path: str, name: str) -> Change:
    """Mistypes a key of experiment.yaml."""

    def change(case: Case) -> None:
        *parents, last = path.split(".")
        section = case.document
        for parent in parents:
            section = section[parent]
        section[name] = section.pop(last)

    return change


def table(old: str, new: str) -> Change:
    """Changes markers.csv."""

    def change(case: Case) -> None:
        assert old in case.markers
        case.markers = case.markers.replace(old, new, 1)

    return change


def frames(change: Callable[[MarkerFrame], MarkerFrame], rows: Sequence[int] | None = None) -> Change:
    """Changes the measured frames, or those with the numbers ``rows``."""

    def spoil(case: Case) -> None:
        chosen = range(len(case.frames)) if rows is None else rows
        for k in chosen:
            case.frames[k] = change(case.frames[k])

    return spoil


def poses(change: Callable[[Pose], Pose], rows: Sequence[int] | None = None) -> Change:
    """Changes the poses, or those with the numbers ``rows``."""

    def spoil(case: Case) -> None:
        chosen = range(len(case.poses)) if rows is None else rows
        for k in chosen:
            case.poses[k] = change(case.poses[k])

    return spoil


def moved(dx: float = 0.0, dz: float = 0.0, factor: float = 1.0, later: int = 0) -> Callable[[Any], Any]:
    """A frame or a pose elsewhere, in another unit, or at another time (ns)."""

    def change(item: Any) -> Any:
        shift = np.array([dx, 0.0, dz])
        if isinstance(item, Pose):
            return replace(item, stamp_ns=item.stamp_ns + later, position=factor * item.position + shift)
        return replace(item, stamp_ns=item.stamp_ns + later, points=factor * item.points + shift)

    return change


def with_covariance(value: float, diagonal_only: bool = True) -> Callable[[MarkerFrame], MarkerFrame]:
    """A frame whose covariances have this on the first axis."""

    def change(frame: MarkerFrame) -> MarkerFrame:
        covariances = frame.covariances.copy()
        covariances[:, 0, 0] = value
        if not diagonal_only:
            covariances[:, 0, 1] = covariances[:, 1, 0] = value
        return replace(frame, covariances=covariances)

    return change


def relabelled(first: int) -> Callable[[MarkerFrame], MarkerFrame]:
    return lambda frame: replace(frame, ids=frame.ids + np.uint32(first))


def drop(name: str) -> Change:
    """Leaves the frames or the poses out."""
    return lambda case: setattr(case, name, [])


def both(*changes: Change) -> Change:
    def change(case: Case) -> None:
        for one in changes:
            one(case)

    return change


def _wrong_type(case: Case) -> None:
    case.poses = []
    case.extra.append((t.PROBE_POSE, t.FLOAT64, encode(message_class(t.FLOAT64)(1.0))))


EXPERIMENTS: dict[str, Change] = {
    "relaxation of -0.5": effect("viscoelasticity", g=[-0.5], tau=[1.0]),
    "relaxation of 1": effect("viscoelasticity", g=[1.0], tau=[1.0]),
    "relaxations that add up to 1.2": effect("viscoelasticity", g=[0.6, 0.6], tau=[1.0, 5.0]),
    "two relaxations, one time": effect("viscoelasticity", g=[0.2, 0.2], tau=[1.0]),
    "relaxation time 0": effect("viscoelasticity", g=[0.2], tau=[0.0]),
    "relaxation time -1 s": effect("viscoelasticity", g=[0.2], tau=[-1.0]),
    "relaxation that is not a number": effect("viscoelasticity", g=[float("nan")], tau=[1.0]),
    "stiffness ratio -1": effect("stiffness", ratio=-1.0),
    "stiffness ratio 0": effect("stiffness", ratio=0.0),
    "stiffness ratio infinite": effect("stiffness", ratio=float("inf")),
    "inclusion ratio -2": effect("inclusion", centre=[0.0, 0.0, 0.015], radius=0.005, ratio=-2.0),
    "inclusion radius -5 mm": effect("inclusion", centre=[0.0, 0.0, 0.015], radius=-0.005, ratio=2.0),
    "skin thickness -2 mm": effect("skin", thickness=-0.002, ratio=2.0),
    "skin ratio 0": effect("skin", thickness=0.002, ratio=0.0),
    "friction of the effect -0.3": effect("probe_friction", mu=-0.3),
    "friction of the contact -0.1": key("probe.contact", {"friction": -0.1}),
    "adhesion -10 Pa": effect("probe_adhesion", strength=-10.0),
    "density -1000": key("phantom.density", -1000.0),
    "density ratio -1": effect("density", ratio=-1.0),
    "scale 0": effect("stereo_scale", scale=0.0),
    "scale -1": effect("stereo_scale", scale=-1.0),
    "refraction 0": effect("refraction", index=0.0),
    "swelling -1.5": effect("swelling", rate=0.0, offset=-1.5),
    "Poisson ratio 0.5 of the effect": effect("poisson_ratio", value=0.5),
    "Poisson ratio -1.2 of the effect": effect("poisson_ratio", value=-1.2),
    "Poisson ratio 0.5 of the material": key("phantom.material.poisson_ratio", 0.5),
    "modulus not a number": key("phantom.material.youngs_modulus", float("nan")),
    "modulus in kPa": key("phantom.material.youngs_modulus", 8.0),
    "gravity infinite": key("phantom.gravity", [0.0, 0.0, float("-inf")]),
    "plastic fraction 1.2": effect("plastic_set", fraction=1.2, threshold=0.05),
    "plastic threshold -0.1": effect("plastic_set", fraction=0.2, threshold=-0.1),
    "base loose by 150 %": effect("base_debonding", direction=0.0, fraction=1.5),
    "base springs of -1 Pa/m": effect("base_slip", stiffness=-1.0),
    "damping -1 s": effect("inertia", rayleigh_beta=-1.0),
    "150 % of the scan's gravity": effect("scan_gravity", fraction=1.5),
    "stiffness gradient below 0": effect("stiffness_gradient", slope=200.0),
    "stiffening -1": effect("strain_stiffening", b=-1.0),
    "tilt in degrees": effect("gravity_tilt", angle_x=90.0, angle_y=0.0),
    "camera moves before the start": effect(
        "camera_motion", translation=[0.0] * 3, rotation=[0.0] * 3, onset=-5.0),
    "sigma of an effect -0.1": effect("stiffness", ratio=1.1, ratio_sigma=-0.1),
    "yeoh c1 negative": key("phantom.material", {
        "model": "yeoh", "youngs_modulus": 8000.0, "poisson_ratio": 0.49, "c1": -1.0}),
    "ogden, two mu and one alpha": key("phantom.material", {
        "model": "ogden", "youngs_modulus": 8000.0, "poisson_ratio": 0.49, "mu": [1.0, 2.0], "alpha": [2.0]}),
    "a key mistyped": renamed("phantom.material.youngs_modulus", "youngs_modlus"),
    "a section mistyped": renamed("phantom", "phantm"),
    "a parameter mistyped": effect("stiffness", ration=1.2),
    "threshold of 5 m": key("thresholds.error", 5.0),
    "threshold of 2 mm in mm": key("thresholds.error", 2.0),
    "lesion in mm": key("phantom.lesions", [{"name": "t", "centre": [0.0, 0.0, 0.015], "diameter": 2.0}]),
    "sigma of a marker in mm": both(
        table("id,x,y,z", "id,x,y,z,sigma"), table("1,-0.016,-0.016,0.03", "1,-0.016,-0.016,0.03,0.5")),
    "ball in mm": key("probe", {"shape": {"sphere": 2.0}}),
    "cylinder in mm": key("probe", {"shape": {"cylinder": [1.5, 0.04]}}),
    "box in mm": key("probe", {"shape": {"box": [0.6, 2.0, 2.0]}}),
    "inclusion beside the body": effect("inclusion", centre=[0.0, 0.1, 0.025], radius=0.006, ratio=5.0),
    "inclusion's centre in mm": effect("inclusion", centre=[0.0, 10.0, 25.0], radius=0.006, ratio=5.0),
    "inclusion's radius in mm": effect("inclusion", centre=[0.0, 0.0, 0.015], radius=6.0, ratio=5.0),
    "skin in mm": effect("skin", thickness=2.0, ratio=5.0),
    "probe's offset in mm": effect("probe_offset", translation=[0.0, 0.0, 1.0]),
    "cameras' motion in mm": effect("camera_motion", translation=[0.0, 2.0, 0.0], rotation=[0.0] * 3, onset=0.0),
    "rest off by millimetres in mm": effect("reference_pose", translation=[3.0, 0.0, 0.0], rotation=[0.0] * 3),
    "warming without a temperature": effect("thermal_expansion", alpha=3e-4),
    "a column of markers.csv twice": table("id,x,y,z", "id,x,y,x,z"),
    "a line of markers.csv too long": table("1,-0.016,-0.016,0.03", "1,-0.016,-0.016,0.03,0,0,0,0"),
    "an id of markers.csv twice": table("2,-0.016,0,0.03", "1,-0.016,0,0.03"),
    "lesion outside the body": key("phantom.lesions", [{"name": "t", "centre": [0.0, 0.0, 1.0], "diameter": 0.01}]),
}  # fmt: skip
"""Changes of an experiment; all must be refused when it is loaded."""

LARGE: dict[str, Change] = {
    "plate of 0.4 m": key("probe", {"shape": {"box": [0.4, 0.4, 0.01]}}),
    "threshold as large as the body": key("thresholds.error", 0.04),
    "lesion as large as the body": key(
        "phantom.lesions", [{"name": "t", "centre": [0.0, 0.0, 0.015], "diameter": 0.04}]
    ),
    "inclusion beyond the body": effect("inclusion", centre=[0.0, 0.0, 0.015], radius=0.08, ratio=5.0),
    "inclusion that reaches in": effect("inclusion", centre=[0.0, 0.0, 0.035], radius=0.01, ratio=5.0),
    "skin as thick as the body": effect("skin", thickness=0.04, ratio=5.0),
    "tool 0.3 m long": effect("probe_offset", translation=[0.0, 0.0, 0.3]),
}
"""Changes of an experiment that are large, but can be; none may be refused."""

RECORDINGS: dict[str, Change] = {
    "modulus in kPa of a soft body": key("phantom.material.youngs_modulus", 25.0),
    "tilt of 2 degrees in degrees": effect("gravity_tilt", angle_x=2.0, angle_y=0.0),
    "markers without ids": lambda case: setattr(case, "with_ids", False),
    "ids of another experiment": frames(relabelled(100)),
    "some ids of another experiment": frames(
        lambda frame: replace(frame, ids=np.where(frame.ids > 8, frame.ids + 90, frame.ids).astype(np.uint32))),
    "declared probe, no poses": drop("poses"),
    "nothing measured": drop("frames"),
    "poses, but no probe": lambda case: case.document.pop("probe"),
    "poses in mm": poses(moved(factor=1e3)),
    "poses in another frame": poses(moved(dx=5.0)),
    "probe starts inside the body": poses(moved(dz=-0.004)),
    "probe upside down": poses(lambda pose: replace(pose, orientation_xyzw=np.array([0.0, 0.0, 0.0, 1.0]))),
    "probe never touches": poses(moved(dz=0.02)),
    "orientation is no rotation": poses(lambda pose: replace(pose, orientation_xyzw=np.zeros(4)), [5]),
    "markers in mm": frames(moved(factor=1e3)),
    "markers in another frame": frames(moved(dx=1.0)),
    "a few clouds 1000 times too far": frames(moved(factor=1e3), [7, 8]),
    "markers all not a number": frames(moved(factor=float("nan"))),
    "covariances negative": frames(with_covariance(-1e-9)),
    "covariances infinite": frames(with_covariance(float("inf"))),
    "covariances in part not a number": frames(with_covariance(float("nan")), [3]),
    "covariances with a negative eigenvalue": frames(with_covariance(1e-6, diagonal_only=False)),
    "frame id of the camera": lambda case: setattr(case, "frame_id", t.FRAME_LEFT),
    "one frame from another year": frames(moved(later=-3 * YEAR_NS), [9]),
    "one pose from another year": poses(moved(later=5 * YEAR_NS), [11]),
    "first frame from 1970": frames(lambda frame: replace(frame, stamp_ns=1_000_000_000), [0]),
    "clocks of probe and cameras differ": poses(moved(later=3_600_000_000_000)),
    "poses end before half of the frames": lambda case: case.poses.__delitem__(slice(15, None)),
    "every stamp 0": both(
        frames(lambda frame: replace(frame, stamp_ns=0)), poses(lambda pose: replace(pose, stamp_ns=0))),
    "release after the end": key("timeline", {"release": 60.0}),
    "shrinks to nothing within the recording": effect("swelling", rate=-1.0, offset=0.0),
    "poses of the wrong type": _wrong_type,
}  # fmt: skip
"""Changes of a recording; each must be refused or warned of before it is used."""


def judged(name: str, folder: Path) -> tuple[str, str]:
    """What the tool makes of a situation: "refused", "warned" or "silently wrong", and its words."""
    case = sound(folder)
    (EXPERIMENTS | RECORDINGS)[name](case)
    bag = case.write()
    try:
        experiment = load_experiment(case.experiment)
        with read_bag(bag) as reader:
            findings = fit_findings(reader, experiment, load_recording(bag, experiment))
    except InputError as error:
        return "refused", str(error)
    for level, word in (("ERROR", "refused"), ("WARN", "warned")):
        for finding in findings:
            if finding.level == level:
                return word, finding.text
    return "silently wrong", ""


def judged_pair(folder: Path, name: str) -> tuple[str, str]:
    """The same of a fit and a test recording."""
    case = sound(folder)
    bag = case.write()
    experiment = load_experiment(case.experiment)
    fit, test = PAIRS[name](case, bag)
    try:
        load_checked(fit, test, experiment)
    except InputError as error:
        return "refused", str(error)
    return "silently wrong", ""


def _copy(case: Case, name: str, first: int) -> Path:
    """The same recording from its frame ``first``, under another name."""
    return small.write_bag(case.folder / name, case.poses[first:], case.frames[first:])


PAIRS: dict[str, Callable[[Case, Path], tuple[list[Path], list[Path]]]] = {
    "fit and test the same file": lambda case, bag: ([bag], [bag]),
    "fit and test the same moments": lambda case, bag: ([bag], [_copy(case, "other.mcap", 0)]),
    "fit and test overlap": lambda case, bag: ([bag], [_copy(case, "other.mcap", N // 2)]),
    "one recording fitted twice": lambda case, bag: ([bag, bag], []),
}
"""Recordings of a diagnosis; all must be refused."""


def judged_run(name: str, folder: Path) -> tuple[str, str]:
    """What ``livedeform run`` makes of a recording: refused by its exit code, warned of by its verdict or a line."""
    import json

    from livedeform.run.running import RunOptions, run

    case = sound(folder)
    RECORDINGS[name](case)
    bag = case.write()
    said: list[str] = []
    try:
        metrics = run(RunOptions(case.experiment, bag, folder / "out"), lambda text, *_: said.append(text))
    except InputError as error:
        return "refused", str(error)
    warnings = [text for text in said if text.startswith("warning")]
    if metrics.level != "OK":
        return "warned", json.loads((folder / "out" / "metrics.json").read_text())["reason"]
    return ("warned", warnings[0]) if warnings else ("silently wrong", "")
