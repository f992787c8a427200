"""Describe what ``livedeform info`` shows: what a bag, an experiment or a run holds, and whether it is sound."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from livedeform.common import topics as t
from livedeform.common.bags.pictures import read_camera_info
from livedeform.common.bags.read import BagReader, read_bag
from livedeform.common.bags.recording import Recording, header_stamp_ns, load_recording, to_image
from livedeform.common.bags.types import RawMessage, decode
from livedeform.common.checks.clocks import OFFSET_DRIFT
from livedeform.common.checks.declared import check_declared
from livedeform.common.checks.finding import Finding, Severity
from livedeform.common.checks.protocol import ProtocolStep, protocol
from livedeform.common.checks.recorded import check_named, check_recording, other_frame
from livedeform.common.errors import CalibrationError, InputError, MeshError, RecordingError
from livedeform.common.experiment.plausibility import TETRAHEDRON_VOLUME, read_body
from livedeform.common.experiment.schema import Markers
from livedeform.common.experiment.yaml_file import FILE_NAME, Experiment, load_experiment
from livedeform.common.types import CameraCalibration

GAP_FACTOR = 3.0  # an interval this many times the median counts as a gap
MIN_GAP = 0.02  # s
CLOCK_SET_NS = 10**17  # March 1973: a clock that shows less was never set
LARGE_OFFSET = 1.0  # s between stamp and receive time
DECODED = (t.STEREO_MARKERS, t.PROBE_POSE, t.PROBE_WRENCH)  # message by message; pictures would take too long
STREAMS = (t.STEREO_MARKERS, t.STEREO_SURFACE, t.PROBE_POSE, *t.IMAGES, *t.COMPRESSED_IMAGES)
# what every diagnosis.json has (interfaces, section 5)
OF_A_DIAGNOSIS = ("version", "verdict", "effects", "candidates", "error_before", "error_after", "noise_floor",
                  "improvement_interval", "unexplained")  # fmt: skip


@dataclass(frozen=True)
class TopicReport:
    """A topic in numbers. Rates and gaps are of the stamps where messages have one, else of the receive times.

    ``offset_s`` is the median of receive time minus stamp, NaN without stamps.
    """

    name: str
    type: str
    count: int
    rate_hz: float
    n_gaps: int
    longest_gap_s: float
    n_backwards: int
    n_duplicates: int
    offset_s: float
    offset_range_s: float
    stamps_unset: bool = False
    note: str = ""


@dataclass(frozen=True)
class Report:
    """Everything that is printed: ``facts`` as name and value, tables, findings, and the ``protocol``'s steps for a
    press."""

    kind: Literal["bag", "experiment", "run", "diagnosis"]
    path: str
    facts: dict[str, str] = field(default_factory=dict)
    topics: tuple[TopicReport, ...] = ()
    findings: tuple[Finding, ...] = ()
    protocol: tuple[ProtocolStep, ...] = ()

    @property
    def sound(self) -> bool:
        return not any(finding.level == "ERROR" for finding in self.findings)


def inspect(path: Path, experiment: Path | None = None) -> Report:
    """Finds out what ``path`` is and reports on it; ``experiment`` adds whether a bag fits it."""
    loaded = load_experiment(experiment) if experiment is not None else None
    if path.is_dir() and (path / "diagnosis.json").is_file():
        return _inspect_diagnosis(path)
    if path.is_dir() and (path / "run.mcap").is_file():
        return _inspect_run(path, loaded)
    if path.suffix in (".yaml", ".yml") or (path / FILE_NAME).is_file():
        return inspect_experiment(path)
    if not path.exists():
        raise InputError(
            "does not exist", where=str(path), remedy="name a bag, an experiment's folder or a run's folder"
        )
    return inspect_bag(path, loaded)


# --- bags ------------------------------------------------------------------------------------------------------------


def inspect_bag(path: Path, experiment: Experiment | None = None) -> Report:
    """Topics, rates, gaps, stamp problems; with an ``experiment``, whether the bag serves it."""
    with read_bag(path) as bag:
        findings = [Finding("WARN", warning.removeprefix(f"{path}: ")) for warning in bag.warnings]
        tracks = _Tracks()
        steps: tuple[ProtocolStep, ...] = ()
        for raw in bag.messages():
            tracks.take(raw)
        topics = tuple(tracks.report(info.name, info.type, info.count, info.problem) for info in bag.topics.values())
        findings += _wrong_types(bag) + [f for topic in topics for f in _judge(topic)] + _pairing(tracks)
        findings += [Finding("WARN", f"{name}: {n} messages are damaged") for name, n in tracks.damaged.items()]
        if experiment is not None:
            recording = load_recording(path, experiment)
            findings += fit_findings(bag, experiment, recording)
            if experiment.probe is not None:
                steps = tuple(protocol(recording))
        facts = {
            "begins": f"{bag.start_ns} ns" + _date(bag.start_ns),
            "lasts": f"{(bag.end_ns - bag.start_ns) * 1e-9:.3f} s",
            "messages": str(bag.n_messages),
            **{f"metadata {key}": value for key, value in bag.metadata.items() if _short(key, value)},
        }
    if bag.n_messages == 0:
        findings.append(Finding("ERROR", "the bag is empty"))
    once = tuple(dict.fromkeys(findings))
    return Report("bag", str(path), facts, tuple(sorted(topics, key=lambda topic: topic.name)), once, steps)


def _date(stamp_ns: int) -> str:
    """The day and minute of a stamp in brackets; empty where the clock was not set."""
    if stamp_ns < CLOCK_SET_NS:
        return ""
    return datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC).strftime(" (%Y-%m-%d %H:%M UTC)")


def fit_findings(
    bag: BagReader, experiment: Experiment, recording: Recording, *, is_part: bool = False
) -> list[Finding]:
    """Check whether a bag serves an experiment, by every check that there is; ``is_part``: as of `check_recording`."""
    wrong = _wrong_types(bag)
    if wrong:  # nothing more can be read
        return wrong
    acting = experiment.of_recording(recording.own_name)
    checked = check_recording(recording, acting, is_part=is_part)
    return [*_Fit(bag, acting).findings(), *check_named(recording, acting), *checked]


class _Tracks:
    """Receive times and stamps of every topic."""

    def __init__(self) -> None:
        self.received: dict[str, list[int]] = {}
        self.stamps: dict[str, list[int]] = {}
        self.damaged: dict[str, int] = {}

    def take(self, raw: RawMessage) -> None:
        self.received.setdefault(raw.topic, []).append(raw.log_time_ns)
        stamp = header_stamp_ns(raw)
        if stamp is not None:
            self.stamps.setdefault(raw.topic, []).append(stamp)
        if raw.topic in DECODED:
            try:
                decode(raw)
            except RecordingError:
                self.damaged[raw.topic] = self.damaged.get(raw.topic, 0) + 1

    def report(self, name: str, type_name: str, count: int, problem: str) -> TopicReport:
        received = np.array(self.received.get(name, []), np.int64)
        stamps = np.array(self.stamps.get(name, []), np.int64)
        times = stamps if len(stamps) else received
        steps = np.diff(times) * 1e-9
        ordered = np.diff(np.unique(times)) * 1e-9
        period = float(np.median(ordered)) if len(ordered) else np.nan
        gaps = ordered > np.fmax(GAP_FACTOR * period, MIN_GAP)
        offsets = (received - stamps) * 1e-9 if len(stamps) == len(received) and len(stamps) else np.array([np.nan])
        return TopicReport(
            name=name,
            type=type_name,
            count=count,
            rate_hz=1.0 / period if period > 0 else np.nan,
            n_gaps=int(gaps.sum()),
            longest_gap_s=float(ordered.max()) if len(ordered) else np.nan,
            n_backwards=int((steps < 0).sum()),
            n_duplicates=int((steps == 0).sum()) if len(stamps) else 0,
            offset_s=float(np.median(offsets)),
            offset_range_s=float(np.ptp(offsets)),
            stamps_unset=len(stamps) > 1 and not stamps.any(),
            note="cannot be decoded" if problem else "",
        )


def _wrong_types(bag: BagReader) -> list[Finding]:
    return [
        Finding("ERROR", f"{topic.name} is of type {bag.topics[topic.name].type}; livedeform reads {topic.type}")
        for topic in t.TOPICS.values()
        if topic.input and topic.name in bag.topics and bag.topics[topic.name].type != topic.type
    ]


def _judge(topic: TopicReport) -> list[Finding]:
    """Stamp problems of one topic; only of the topics that livedeform reads."""
    if topic.name not in t.TOPICS or not t.TOPICS[topic.name].input:
        return []
    if topic.stamps_unset:
        return [Finding("ERROR", f"{topic.name}: every stamp is 0; set header.stamp when recording")]
    found = []
    if topic.n_backwards:
        found.append(
            Finding("WARN", f"{topic.name}: {topic.n_backwards} stamps go back in time; frames are sorted by stamp")
        )
    if topic.n_duplicates:
        found.append(Finding("WARN", f"{topic.name}: {topic.n_duplicates} stamps are there twice; the first counts"))
    if topic.n_gaps and topic.name in STREAMS:
        text = f"{topic.name}: {topic.n_gaps} gaps, the longest {topic.longest_gap_s:.3f} s at {topic.rate_hz:.1f} Hz"
        found.append(Finding("WARN", text))
    if topic.offset_range_s > OFFSET_DRIFT and topic.name in STREAMS:
        text = f"{topic.name}: receive time minus stamp changes by {topic.offset_range_s:.3f} s: drift or a full queue"
        found.append(Finding("WARN", text))
    if abs(topic.offset_s) > LARGE_OFFSET:
        text = f"{topic.name}: stamps are {topic.offset_s:.3f} s before the receive time; only stamps are used"
        found.append(Finding("NOTE", text))
    return found


def _pairing(tracks: _Tracks) -> list[Finding]:
    """Pictures of one side without a partner of the same stamp, and probe poses that do not cover the markers."""
    found = []
    sides = ((t.LEFT_IMAGE, t.LEFT_COMPRESSED), (t.RIGHT_IMAGE, t.RIGHT_COMPRESSED))
    left, right = (max((tracks.stamps.get(name) or [] for name in names), key=len) for names in sides)
    alone = len(set(left) ^ set(right))
    if left and right and alone:
        found.append(
            Finding("WARN", f"{alone} of {len(left) + len(right)} pictures have no partner with the same stamp")
        )
    if bool(left) != bool(right):
        found.append(Finding("ERROR", f"there are pictures of the {'left' if left else 'right'} camera only"))
    measured = [*left, *tracks.stamps.get(t.STEREO_MARKERS, []), *tracks.stamps.get(t.STEREO_SURFACE, [])]
    poses = tracks.stamps.get(t.PROBE_POSE, [])
    if measured and poses:
        outside = sum(not min(poses) <= stamp <= max(poses) for stamp in measured)
        if outside:
            share = outside / len(measured)
            level: Severity = "ERROR" if share > 0.99 else "WARN" if share > 0.05 else "NOTE"
            text = f"{outside} of {len(measured)} measured moments lie outside the time of the probe's poses"
            found.append(Finding(level, text + (": the clocks differ" if share > 0.99 else "")))
    return found


class _Fit:
    """Does a bag have what an experiment needs, and do its cameras go with it?"""

    def __init__(self, bag: BagReader, experiment: Experiment) -> None:
        self.bag, self.experiment = bag, experiment

    def findings(self) -> list[Finding]:
        return [*self._inputs(), *self._cameras()]

    def _has(self, *names: str) -> bool:
        return any(name in self.bag.topics and self.bag.topics[name].count for name in names)

    def _first(self, name: str) -> Any:
        for raw in self.bag.messages([name]):
            return decode(raw)
        return None

    def _inputs(self) -> list[Finding]:
        found = []
        pictures = self._has(t.LEFT_IMAGE, t.LEFT_COMPRESSED) and self._has(t.RIGHT_IMAGE, t.RIGHT_COMPRESSED)
        if not pictures and not self._has(t.STEREO_MARKERS, t.STEREO_MARKERS_RAW, t.STEREO_SURFACE):
            found.append(
                Finding(
                    "ERROR",
                    f"there are no stereo pictures, {t.STEREO_MARKERS} or {t.STEREO_SURFACE}: nothing was measured",
                )
            )
        surface = self._first(t.STEREO_SURFACE) if self._has(t.STEREO_SURFACE) else None  # others: `check_frames`
        if surface is not None and surface.header.frame_id not in (t.FRAME_PHANTOM, ""):
            found.append(other_frame(t.STEREO_SURFACE, surface.header.frame_id))
        return found

    def _cameras(self) -> list[Finding]:
        from livedeform.stereo_node.camera.calibration_file import read_camera

        found: list[Finding] = []
        stereo = self.experiment.stereo
        sides = (
            ("left", t.LEFT_IMAGE, t.LEFT_CAMERA_INFO, stereo.left if stereo else None),
            ("right", t.RIGHT_IMAGE, t.RIGHT_CAMERA_INFO, stereo.right if stereo else None),
        )
        for side, image_topic, info_topic, file in sides:
            name = next((n for n in (image_topic, image_topic + "/compressed") if self._has(n)), None)
            if name is None:
                continue
            if stereo is None:
                return [Finding("ERROR", "there are pictures, but the experiment has no section 'stereo'")]
            camera: CameraCalibration | None = None
            if file is not None:
                camera = read_camera(file)
            elif self._has(info_topic):
                camera = read_camera_info(self._first(info_topic))
            if camera is None:
                text = f"the {side} camera has no calibration: name stereo.{side}, or record {info_topic}"
                found.append(Finding("ERROR", text))
                continue
            found += self._picture_size(side, name, camera)
        return found

    def _picture_size(self, side: str, topic: str, camera: CameraCalibration) -> list[Finding]:
        height, width = to_image(next(iter(self.bag.messages([topic])))).pixels.shape[:2]
        if (width, height) == (camera.width, camera.height):
            return []
        text = f"{side} pictures are {width} x {height}, but the calibration is for {camera.width} x {camera.height}"
        return [Finding("ERROR", text)]


# --- experiments, runs, diagnoses ------------------------------------------------------------------------------------


def inspect_experiment(path: Path) -> Report:
    """The facts of an experiment that is sound; ``InputError`` with the first mistake of one that is not."""
    experiment = load_experiment(path)
    phantom, markers = experiment.phantom, experiment.markers
    body = read_body(experiment)
    size = body.upper - body.lower
    mass = phantom.density * body.volume
    material = phantom.material
    modulus_sigma = experiment.sigma("phantom.material.youngs_modulus")
    facts = {
        "name": experiment.name,
        "body": f"{' x '.join(f'{1e3 * s:.1f}' for s in size)} mm, {1e6 * body.volume:.1f} ml, {1e3 * mass:.1f} g",
        "scanned": f"{phantom.configuration}, gravity {_vector(phantom.gravity)} m/s2",
        "elements": _elements(phantom.element_size, body.volume),
        "material": f"{material.model}, E {material.youngs_modulus / 1e3:g} kPa"
        + (f" +- {modulus_sigma / 1e3:g}" if modulus_sigma else "")
        + f", Poisson {material.poisson_ratio:g}",
        "markers": _kinds(markers),
        "lesions": ", ".join(f"{x.name} ({1e3 * x.diameter:g} mm)" for x in experiment.lesions) or "none",
        "probe": f"{experiment.probe.shape.kind}, {experiment.probe.contact.formulation}"
        if experiment.probe
        else "none",
        "cameras": f"pose {'registered' if experiment.stereo.pose == 'registered' else 'given'}, detector "
        + experiment.stereo.detector.type
        if experiment.stereo
        else "none",
        "loads": ", ".join(f"{x.name} {_vector(x.force)} N" for x in experiment.loads) or "none",
        "release": f"{experiment.timeline.release:g} s",
        "otherwise": "; ".join(f"{name}: {override.text}" for name, override in experiment.recordings.items())
        or "never",
        "effects": ", ".join(effect.name for effect in experiment.effects) or "none",
        "verdict at": f"{1e3 * experiment.thresholds.error:g} mm",
    }
    findings = _body_findings(experiment) + check_declared(experiment, body) + _calibration_findings(experiment)
    if experiment.stereo is not None:
        findings += _detector_findings(experiment)
    if 0 < len(markers.ids) < 3:
        findings.append(Finding("WARN", "fewer than three markers: the cameras cannot be registered to them"))
    return Report("experiment", str(experiment.path), facts, (), tuple(findings))


def _kinds(markers: Markers) -> str:
    """Count the markers of each kind."""
    if not len(markers.ids):
        return "none, for points without ids"
    kinds = {kind: int((markers.kinds == kind).sum()) for kind in ("surface", "internal", "support")}
    return f"{len(markers.ids)}: " + ", ".join(f"{n} {kind}" for kind, n in kinds.items() if n)


def _short(key: str, value: str) -> bool:
    """Return whether a recording's metadata fit on a line; how it was registered is always told."""
    return len(value) < 100 or key == "registration"


def _body_findings(experiment: Experiment) -> list[Finding]:
    """Say what is repaired of the surface that was given, and whether its elements are small enough for it."""
    from livedeform.fem_node.mesh.generate import prepared

    try:
        body = prepared(experiment.phantom)  # type: ignore[arg-type]  # a surface always comes with a size (schema)
    except MeshError as error:
        return [Finding("ERROR", str(error))]
    repairs = [Finding("NOTE", f"repaired: {repair}") for repair in body.record]
    return repairs + [Finding("WARN", line.removeprefix("WARN: ")) for line in body.warnings]


def _calibration_findings(experiment: Experiment) -> list[Finding]:
    from livedeform.stereo_node.camera.setup import rig_of

    try:
        rig = rig_of(experiment)
    except CalibrationError as error:
        return [Finding("ERROR", str(error))]
    if rig is None:
        return []
    sizes = f"{rig.left.width} x {rig.left.height}"
    return [Finding("NOTE", f"cameras: {sizes} px, baseline {1e3 * rig.baseline:.1f} mm")]


def _detector_findings(experiment: Experiment) -> list[Finding]:
    from livedeform.stereo_node.detect.settings import DetectorSettings

    assert experiment.stereo is not None
    detector = experiment.stereo.detector
    try:
        DetectorSettings.from_mapping({"type": detector.type, **detector.settings})
    except InputError as error:
        return [Finding("ERROR", str(error))]
    return []


def _inspect_run(path: Path, experiment: Experiment | None) -> Report:
    bag = inspect_bag(path / "run.mcap", experiment)
    metrics = _document(path / "metrics.json")
    facts = {**_numbers(metrics), **bag.facts}
    findings = list(bag.findings)
    if (path / "metrics.json").is_file() and "verdict" not in metrics:
        findings.append(Finding("WARN", "metrics.json has no verdict: it was changed, or another program wrote it"))
    for name in ("metrics.json", "markers.csv", "report.html"):
        if not (path / name).is_file():
            findings.append(Finding("WARN", f"{name} is missing: the run did not end in order"))
    return Report("run", str(path), facts, bag.topics, tuple(findings), bag.protocol)


def _inspect_diagnosis(path: Path) -> Report:
    from livedeform.closed_loop.assessment.verdict import Verdict  # for a diagnosis only: it takes a moment

    document, verdicts = _document(path / "diagnosis.json"), get_args(Verdict)
    findings = []
    if missing := [key for key in OF_A_DIAGNOSIS if key not in document]:
        text = f"diagnosis.json has no {', '.join(missing)}: it was changed, or another program wrote it"
        findings.append(Finding("ERROR", text, "run livedeform diagnose again"))
    elif document["verdict"] not in verdicts:
        text = f"the verdict of diagnosis.json is {document['verdict']!r}; known are {', '.join(verdicts)}"
        findings.append(Finding("ERROR", text, "run livedeform diagnose again"))
    return Report("diagnosis", str(path), _numbers(document), (), tuple(findings))


def _document(path: Path) -> dict[str, Any]:
    """The content of a JSON file; empty where there is none, and where it holds no names with values."""
    if not path.is_file():
        return {}
    try:
        document = json.loads(path.read_text())
    except ValueError as error:
        raise InputError(f"is not valid JSON ({error})", where=str(path), remedy="run the command again") from error
    return document if isinstance(document, dict) else {}


def _numbers(document: dict[str, Any]) -> dict[str, str]:
    """The plain values of a document, with dotted names."""
    out: dict[str, str] = {}

    def walk(prefix: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, item in value.items():
                walk(f"{prefix}.{key}" if prefix else str(key), item)
        elif isinstance(value, float):
            out[prefix] = f"{value:.6g}"
        elif isinstance(value, str | int) and len(str(value)) < 100:
            out[prefix] = str(value)

    walk("", document)
    return dict(list(out.items())[:60])


def _elements(element_size: float | None, volume: float) -> str:
    if element_size is None:
        return "given as a mesh"
    n = volume / (TETRAHEDRON_VOLUME * element_size**3)
    return f"{1e3 * element_size:g} mm, about {n:.2g} tetrahedra"


def _vector(values: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"
