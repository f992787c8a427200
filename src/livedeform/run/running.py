"""``livedeform run`` and ``livedeform live``: the graph from its inputs to its results."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from livedeform import outputs
from livedeform.common import topics as t
from livedeform.common.bags.read import BagReader, read_bag
from livedeform.common.bags.recording import BEGINS, load_recording, own_name, stamp_range
from livedeform.common.checks.finding import Finding, refuse_errors
from livedeform.common.checks.recorded import check_recording
from livedeform.common.errors import InputError
from livedeform.common.experiment.fitted import in_setting_of
from livedeform.common.experiment.markers_file import write_markers
from livedeform.common.experiment.schema import Markers
from livedeform.common.experiment.yaml_file import (
    FILE_NAME,
    KEPT_MARKERS,
    Experiment,
    files_of,
    keep_experiment,
    load_experiment,
)
from livedeform.common.processes import uninterrupted
from livedeform.common.ros.node import CountingNode
from livedeform.common.ros.session import StopFlag, ros
from livedeform.common.types import Pose
from livedeform.compare_node.interpolation import Interpolated
from livedeform.compare_node.metrics import RunMetrics
from livedeform.compare_node.node import CompareNode
from livedeform.compare_node.surface_error import SURFACE_CSV
from livedeform.comparing.identity import DIGEST, PART, digest_of, is_part
from livedeform.comparing.takes import Take, read_model, read_repeats, refuse_other_meshes
from livedeform.fem_node.node import FemNode
from livedeform.fem_node.path.load_history import earlier_poses, joined, pass_beginning, remembers_for_good
from livedeform.inspection import fit_findings
from livedeform.run import graph as g
from livedeform.run import replay
from livedeform.run.elements import elements
from livedeform.run.recorder import RunRecorder
from livedeform.run.results import write_results
from livedeform.run.scene import LiveScene
from livedeform.run.watch import LiveWatch
from livedeform.stereo_node.correction import format_pose
from livedeform.stereo_node.node import StereoNode

WRITES = (
    "run.mcap", "metrics.json", "markers.csv", "report.html", FILE_NAME, KEPT_MARKERS, "rest_markers.csv", SURFACE_CSV,
    "view.html",
)  # fmt: skip
ISOLATE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
SAY_EVERY = 2.0  # s
MOST_REASONS = 5  # why predictions were refused, that are written down
PATIENCE = 2.0  # s, for messages that are still on their way in the end

Tell = Callable[..., None]


@dataclass(frozen=True)
class RunOptions:
    """``rate`` None plays in lock step; ``model`` is a fitted experiment, whose body takes the experiment's place;
    ``at_frames`` predicts at the measured frames' stamps, with the pose interpolated, instead of at every pose;
    ``after``: recordings that the body went through before, the earliest first; ``repeats``: runs of other takes of the
    same press with the same model."""

    experiment: Path
    bag: Path
    out: Path
    rate: float | None = None
    start: float = 0.0
    duration: float | None = None
    model: Path | None = None
    force: bool = False
    at_frames: bool = False
    after: tuple[Path, ...] = ()
    repeats: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Source:
    """The recording that is run: its ``digest`` (`digest_of`), and whether the ``whole`` of it is."""

    digest: str
    whole: bool = True

    @property
    def metadata(self) -> dict[str, str]:
        """Return what a run's recording says of it."""
        return {DIGEST: self.digest} | ({} if self.whole else {PART: "yes"})


@dataclass(frozen=True)
class Nodes:
    """The nodes of a graph; None where one is not needed, or runs in another process. The model found no equilibrium at
    ``n_missed`` of the poses before the part that is run."""

    stereo: StereoNode | None
    fem: FemNode | None
    compare: CompareNode | None
    n_missed: int = 0

    def present(self) -> list[CountingNode]:
        return [node for node in (self.stereo, self.fem, self.compare) if node is not None]

    def serve_state(self) -> None:
        """Let each node answer that it is prepared."""
        for node in self.present():
            node.serve_state()

    def counts(self) -> dict[str, Any]:
        """Count what became of every frame and pose."""
        out: dict[str, Any] = {}
        if self.compare is not None:
            out["association"] = self.compare.counts()
        if self.fem is not None:
            reasons = {"reasons": dict(self.fem.refused.most_common(MOST_REASONS))} if self.fem.refused else {}
            out["model"] = self.fem.counts() | reasons
        if self.stereo is not None:
            unpaired = self.stereo.pairs.n_unpaired + self.stereo.n_refused(*t.IMAGES, *t.COMPRESSED_IMAGES)
            out["stereo"] = {"pairs": self.stereo.pairs.n_pairs, "unpaired": unpaired}
        return out

    @property
    def mesh(self) -> dict[str, Any]:
        """Return the body that is predicted with: its digest, the repairs of its surface, and its report in words."""
        report = None if self.fem is None else self.fem.model.mesh_report
        if report is None:
            return {}
        return {"digest": report.digest, "repairs": list(report.repairs), "report": report.lines()}

    @property
    def interpolated(self) -> Interpolated:
        return self.compare.associator.interpolation_bound.found if self.compare is not None else Interpolated()


def run(options: RunOptions, tell: Tell) -> RunMetrics:
    """Replays a bag through the nodes and writes everything to ``options.out``."""
    return run_into(options, tell)[0]


def run_into(options: RunOptions, tell: Tell) -> tuple[RunMetrics, Path]:
    """Does what `run` does; gives the folder of the results, too.

    That is another one than ``options.out`` where the run was interrupted and there are earlier results: they stay.
    """
    with read_bag(options.bag) as bag:
        name = own_name(options.bag, bag.metadata)
    experiment = model_of(options.experiment, options.model, tell, name)
    if options.rate is not None and not options.rate > 0:
        raise InputError(f"a rate of {options.rate:g} is not positive", where="--rate", remedy="--rate 1.0, or max")
    inputs = [*files_of(experiment), options.bag, options.model, *options.after, *options.repeats]
    prepared = outputs.prepared(options.out, WRITES, force=options.force, inputs=inputs)
    with prepared as draft, read_bag(options.bag) as bag:
        plan, beginning, findings = _checked(bag, experiment, options, tell)
        start_ns, _ = stamp_range(bag)
        ran_of = Source(digest_of(bag), whole=_plays_all(bag, plan, options))
        repeats = _before_it_begins(options, experiment, draft, start_ns, ran_of)
        outputs.write_configuration(draft, about := outputs.configuration("run", asdict(options)))
        with isolated(), ros([]) as stop:
            asked, earlier = replace(options, out=draft), beginning.to_pass
            nodes = make_nodes(draft / "experiment.yaml", plan, asked, start_ns, tell, earlier)
            findings += _left_out(beginning, nodes, tell)
            refuse_other_meshes(repeats, str(nodes.mesh.get("digest", "")))
            described = metadata(about, draft, start_ns) | ran_of.metadata
            counts = _replay(bag, plan, asked, nodes, described, stop, tell)
            bound, mesh, cut = nodes.interpolated, nodes.mesh, bool(stop)  # what comes later cuts nothing
            with uninterrupted():
                ran = load_recording(draft / "run.mcap", experiment)
            if nodes.fem is not None and not cut:
                told = elements(nodes.fem.model, ran.predictions, beginning.played.poses, start_ns, tell)
                mesh, findings = told.described(mesh), [*findings, *told.findings]
            head = _head(experiment, options.bag.name, cut, mesh, ran_of) | registration_of(bag)
            with uninterrupted():
                metrics = write_results(draft, experiment, counts, start_ns, bound, head, findings, ran, repeats)
        write_report(draft, experiment, tell)
        if cut and outputs.has_results(options.out, WRITES):
            return metrics, outputs.put_aside(draft, options.out)
    return metrics, options.out


def model_of(experiment: Path, model: Path | None, tell: Tell, recording: str | None = None) -> Experiment:
    """The experiment, or the fitted ``model`` in it, with what acts on the body in the ``recording`` of that name; None
    of one that is made now. It is said where the two declare other things."""
    declared = load_experiment(experiment)
    if recording is not None:
        declared = declared.of_recording(recording)
    if model is None:
        return declared
    fitted = load_experiment(model)
    together, differences = in_setting_of(fitted if recording is None else fitted.of_recording(recording), declared)
    for difference in differences:
        tell(f"warning: {model} {difference}")
    return together


def _checked(
    bag: BagReader, experiment: Experiment, options: RunOptions, tell: Tell
) -> tuple[replay.Plan, replay.Beginning, list[Finding]]:
    """Return what is played, what came before that, and how it serves the experiment; refuses what does not, and says
    what is in doubt."""
    plan = replay.plan(bag, experiment, at_frames=options.at_frames)
    _refuse_empty(plan, options)
    whole = load_recording(options.bag, experiment)
    played = replay.cut(whole, bag, plan, options.start, options.duration)
    beginning = replay.Beginning(whole, played, experiment)
    fit = fit_findings(bag, experiment, played, is_part=bool(beginning.poses))
    findings = list(dict.fromkeys([*fit, *beginning.findings(plan)]))
    refuse_errors(findings, str(options.bag))
    if options.rate is not None:
        replay.refuse_pauses(bag, plan)
    for warning in dict.fromkeys([*plan.warnings, *(f.text for f in findings if f.level == "WARN")]):
        tell(f"warning: {warning}")
    return plan, beginning, findings


def _left_out(beginning: replay.Beginning, nodes: Nodes, tell: Tell) -> list[Finding]:
    """Doubt a model that found no equilibrium somewhere before the part that is run, and say so."""
    found = beginning.left_out() if nodes.n_missed else []
    for finding in found:
        tell(f"warning: {finding.text}")
    return found


def _plays_all(bag: BagReader, plan: replay.Plan, options: RunOptions) -> bool:
    """Tell whether a whole recording is run: all of the bag, which is no run of a part."""
    return replay.is_whole(plan, options.start, options.duration) and not is_part(bag.metadata)


def _before_it_begins(
    options: RunOptions, experiment: Experiment, draft: Path, start_ns: int, ran_of: Source
) -> list[Take]:
    """Write the experiment, and refuse unfit bags and runs before there is anything to lose; gives the other takes."""
    earlier_poses(options.after, start_ns, experiment.timeline.release)
    keep_experiment(experiment, draft)
    if options.repeats and not ran_of.whole:
        remedy = "run the whole recording, or leave --repeat out"
        raise InputError("a part of a recording is no take", where="--repeat", remedy=remedy)
    return read_repeats(options.repeats, options.bag, ran_of.digest, read_model(draft / FILE_NAME))


def _refuse_empty(plan: replay.Plan, options: RunOptions) -> None:
    """Raises ``InputError`` where nothing is left to play."""
    lasts = (plan.end_ns - plan.start_ns) * 1e-9
    wrong = {"--start": options.start, "--duration": options.duration or 0.0}
    for name, value in wrong.items():
        if not math.isfinite(value) or value < 0.0:
            raise InputError(f"{value:g} s is no time", where=name, remedy="give seconds")
    if options.start > lasts:
        raise InputError(
            f"the recording lasts {lasts:.3g} s, and is to begin at {options.start:g} s",
            where="--start",
            remedy="begin earlier",
        )


def make_nodes(
    experiment: Path, plan: replay.Plan, options: RunOptions, start_ns: int, tell: Tell, earlier: Sequence[Pose] = ()
) -> Nodes:
    """Make the nodes that the plan needs. The model comes first, and goes through the ``earlier`` poses of the
    recording: the cameras are registered to its markers at rest."""
    lock_step = options.rate is None
    expected = "" if lock_step else str(options.bag)
    raw_first = plan.corrected and plan.trigger != "poses"  # a frame is seen through the surface of its own moment
    common = {"experiment": str(experiment), "start_ns": start_ns, "best_effort": False, "raw_first": raw_first}
    fem = FemNode(
        common
        | {"trigger": plan.trigger, "newest_only": not lock_step, "rest_first": plan.corrected, "expected": expected}
        | {"after": joined(options.after)},
        tell,
    )
    n_missed = pass_beginning(fem.model, earlier, tell)
    rest = ""
    is_another = bool(options.after or earlier) and remembers_for_good(fem.model.physics)
    if (plan.measured == "images" or plan.corrected) and needs_rest(fem.experiment, is_another=is_another):
        rest = str(options.out / "rest_markers.csv")
        write_rest(fem, Path(rest))
    stereo = None
    if plan.measured == "images" or plan.corrected:
        source = "pictures" if plan.measured == "images" else "markers"
        place = recorded_camera_pose(options.bag) if source == "markers" else ""
        asked = {"source": source, "rest_markers": rest, "camera_pose": place, "lone_after": 0.0}
        stereo = StereoNode(common | asked)
    compare = CompareNode(
        {"experiment": str(experiment), "stale_after": 0.0 if lock_step else 2.0, "best_effort": False}
    )
    return Nodes(stereo, fem, compare, n_missed)


def needs_rest(experiment: Experiment, *, is_another: bool = False) -> bool:
    """Say whether the markers at rest are elsewhere than declared.

    They are where the surface was scanned under another load, or where the body ``is_another`` since.
    """
    phantom, stereo = experiment.phantom, experiment.stereo
    registered = stereo is None or isinstance(stereo.pose, str)
    other = phantom.configuration == "unloaded" or phantom.gravity != phantom.scan_gravity or bool(experiment.loads)
    wanted = bool(len(experiment.markers.ids)) and registered
    return wanted and (other or is_another) and experiment.timeline.release == 0.0


def write_rest(fem: FemNode, path: Path) -> None:
    """Write the model's markers at rest for the stereo node; ``ConvergenceError`` where it finds no equilibrium."""
    rest = fem.model.rest(needed=True)
    n = len(rest.ids)
    write_markers(path, Markers(rest.ids, rest.markers, np.full(n, np.nan), np.full(n, "surface")))


def recorded_camera_pose(bag: Path) -> str:
    """T_phantom_left of the recording's ``/tf_static``, for the stereo node; empty if there is none."""
    pose = load_recording(bag).camera_pose
    return "" if pose is None else format_pose(pose)


@contextmanager
def isolated(really: bool = True) -> Iterator[None]:
    """Keeps the graph to this process: another run, or a robot, on the same network must not mix with a replay."""
    before = os.environ.get(ISOLATE)
    if really:
        os.environ[ISOLATE] = "OFF"
    try:
        yield
    finally:
        if really:
            os.environ.pop(ISOLATE)
            if before is not None:
                os.environ[ISOLATE] = before


def _replay(
    bag: BagReader,
    plan: replay.Plan,
    options: RunOptions,
    nodes: Nodes,
    described: Mapping[str, str],
    stop: StopFlag,
    tell: Tell,
) -> dict[str, Any]:
    """Play the bag to the nodes, into a recording that is ``described`` so; return the counts."""
    now_ns = plan.start_ns
    latest = 0.0
    scene = LiveScene(load_experiment(options.out / "experiment.yaml", geometry=False))
    with RunRecorder(options.out / "run.mcap", described, lambda: now_ns, derive=scene.derive) as recorder:
        player = g.Player(sorted(set(plan.topics.values())))
        with g.Graph([*nodes.present(), g.RecorderNode(recorder), player], stop) as graph:
            graph.start()
            played = replay.messages(bag, plan, options.start, options.duration)
            with stopped_at_once(graph.stop, tell):
                if options.rate is None:
                    for raw in g.play_in_lock_step(graph, player, played):
                        now_ns = raw.log_time_ns
                        tell(*_at(now_ns, plan))
                else:
                    for raw, late in g.play_in_real_time(graph, player, played, options.rate):
                        now_ns, latest = raw.log_time_ns, max(latest, late)
                        tell(*_at(now_ns, plan))
                    wait_for(graph, nodes)
                graph.finish(None if options.rate is None else PATIENCE)
            counts = nodes.counts() | {"lost_messages": graph.lost(), "inputs": dict(player.traffic.sent)}
            counts["traffic"] = graph.balance()
        if options.rate is not None:
            counts["replay"] = {"latest_s": round(latest, 3)}
            if latest > 0.1:
                tell(f"warning: messages were played up to {latest:.1f} s late; the machine is too slow for this rate")
        counted = {"counts": yaml.safe_dump(counts, sort_keys=False)}
        recorder.add_metadata(counted | ({PART: "yes"} if stop else {}))
    return counts


def wait_for(graph: g.Graph, nodes: Nodes) -> None:
    """Lets the model finish what it works on; no longer than `PATIENCE` where a stop was asked for."""
    deadline = math.inf
    while nodes.fem is not None and nodes.fem.worker.busy and time.monotonic() < deadline:
        graph.spin_once(0.05)
        if graph.stop:
            deadline = min(deadline, time.monotonic() + PATIENCE)


@contextmanager
def stopped_at_once(stop: StopFlag, tell: Tell) -> Iterator[None]:
    """Go on behind the ``with`` block after a second stop signal: what was recorded until then gets its results.

    It interrupts wherever the block is; what rclpy makes of that in its own code need not be a ``KeyboardInterrupt``.
    """
    try:
        yield
        stop.finishing = True
    except BaseException:
        if not stop.finishing:  # a second signal sets it
            raise
        tell("stopped at once: what is recorded so far counts")


def _head(experiment: Experiment, bag: str, cut: bool, mesh: Any, ran_of: Source) -> dict[str, Any]:
    """Return what ``metrics.json`` begins with."""
    recording = {"digest": ran_of.digest, "whole": ran_of.whole and not cut}
    return {"experiment": experiment.name, "bag": bag, "recording": recording, "interrupted": cut, "mesh": mesh}


def registration_of(bag: BagReader) -> dict[str, Any]:
    """Return how a recording of points without ids was registered, as its metadata say; nothing where they do not."""
    try:
        sigma = float(bag.metadata.get("registration_sigma_m", "nan"))
    except ValueError:  # written by somebody else
        return {}
    if not np.isfinite(sigma):
        return {}
    return {"registration": {"text": bag.metadata.get("registration", ""), "sigma_m": sigma}}


def metadata(about: Mapping[str, Any], out: Path, begins_ns: int | None = None) -> dict[str, str]:
    """Collect what a recording says about itself: versions, options, the effective experiment, and of a run when the
    recording ``begins_ns`` that is run: its times count from there."""
    return ({} if begins_ns is None else {BEGINS: str(begins_ns)}) | {
        "command": str(about["command"]),
        "started": str(about["started"]),
        **{f"version {name}": version for name, version in about["versions"].items()},
        "options": yaml.safe_dump(about["options"], sort_keys=False),
        "experiment": (out / "experiment.yaml").read_text(),
    }


def _at(now_ns: int, plan: replay.Plan) -> tuple[str, float]:
    """Say how far the replay is, in words and as a share."""
    done, whole = (now_ns - plan.start_ns) * 1e-9, (plan.end_ns - plan.start_ns) * 1e-9
    return f"replaying {done:.1f} of {whole:.1f} s", done / max(whole, 1e-9)


def write_report(out: Path, experiment: Experiment, tell: Tell) -> None:
    """``report.html``; Ctrl-C leaves it out, and nothing else."""
    try:
        tell("writing the report")
        from livedeform.report.run import page  # takes a second

        page.write_report(out, experiment)
    except KeyboardInterrupt:
        tell(f"stopped: the report is left out; 'livedeform report {outputs.final(out)}' writes it")


# --- live ------------------------------------------------------------------------------------------------------------


def live(
    experiment_path: Path,
    out: Path,
    names: Sequence[str],
    *,
    model: Path | None = None,
    after: Sequence[Path] = (),
    expected: Path | None = None,
    force: bool,
    tell: Tell,
) -> RunMetrics:
    """Runs the nodes called ``names`` on live topics and records until interrupted, then writes the results.

    ``model``, ``after``: as in `RunOptions`. ``expected``: a recording along whose poses the live model is prepared
    before the session is ready.
    """
    experiment = model_of(experiment_path, model, tell)
    earlier_poses(after, time.time_ns(), experiment.timeline.release)
    options = {"experiment": experiment_path, "out": out, "nodes": list(names), "after": list(after)}
    about = outputs.configuration("live", options | {"model": model, "expected": expected})
    read = [*files_of(experiment), model, *after, expected]
    with outputs.prepared(out, WRITES, force=force, inputs=read, in_place=True) as draft:
        if draft != out:
            tell(f"the earlier results stay until this session ends; until then it is recorded in {draft}")
        keep_experiment(experiment, draft)
        outputs.write_configuration(draft, about)
        watch = LiveWatch(experiment)
        with ros([]) as stop:
            began = time.monotonic()
            nodes = make_live_nodes(experiment, draft, names, after, tell, expected)
            derive = LiveScene(experiment).derive
            with RunRecorder(draft / "run.mcap", metadata(about, draft), time.time_ns, watch.take, derive) as recorder:
                hearer = g.RecorderNode(recorder, best_effort=True, show=True)
                with g.Graph(nodes.present(), stop, hearer, recorder.flush_soon) as graph:
                    graph.start()
                    nodes.serve_state()
                    tell(f"ready, after {time.monotonic() - began:.0f} s of preparing")
                    counts = _listen(graph, nodes, recorder, watch, tell)
                recorder.add_metadata({"counts": yaml.safe_dump(counts, sort_keys=False)})
            with uninterrupted():
                recording = load_recording(draft / "run.mcap", experiment)
                findings = [
                    *check_recording(recording, experiment),
                    *(_several(topic, n) for topic, n in counts["publishers"].items()),
                ]
                head = _head(experiment, "live", False, nodes.mesh, _heard(draft / "run.mcap"))
                begin_ns, bound = recording.start_ns, nodes.interpolated  # by stamps, maybe of another clock
                metrics = write_results(draft, experiment, counts, begin_ns, bound, head, findings, recording)
        write_report(draft, experiment, tell)
    return metrics


def _heard(path: Path) -> Source:
    """Return what a live session recorded."""
    with read_bag(path) as bag:
        return Source(digest_of(bag))


def _said_of_model(nodes: Nodes) -> str:
    """Say how the model keeps up, where it runs here."""
    if nodes.fem is None:
        return ""
    counts = nodes.fem.counts()
    failed = f", {counts['not_converged']} without equilibrium" if counts["not_converged"] else ""
    return f"; {counts['predicted']} poses predicted, {counts['skipped']} overtaken by newer ones{failed}"


def _several(topic: str, n: int) -> Finding:
    """More than one publisher on a topic: what is heard is a mixture."""
    text = f"{topic} has {n} publishers: what is heard is a mixture of them"
    return Finding("WARN", text, "stop the others, or give each graph a ROS_DOMAIN_ID of its own", doubts=True)


def make_live_nodes(
    experiment: Experiment,
    out: Path,
    names: Sequence[str],
    after: Sequence[Path],
    tell: Tell,
    expected: Path | None = None,
) -> Nodes:
    """The nodes that run in this process; the live model is prepared along the poses of ``expected``."""
    common = {"experiment": str(out / "experiment.yaml")}
    poses = {"after": joined(after), "expected": "" if expected is None else str(expected)}
    fem = FemNode(common | poses, tell) if "fem" in names else None
    rest = ""
    is_another = fem is not None and bool(after) and remembers_for_good(fem.model.physics)
    if fem is not None and experiment.stereo is not None and needs_rest(experiment, is_another=is_another):
        rest = str(out / "rest_markers.csv")
        write_rest(fem, Path(rest))
    stereo = None
    if "stereo" in names and experiment.stereo is not None:
        stereo = StereoNode(common | {"rest_markers": rest})
    compare = CompareNode(common) if "compare" in names else None
    return Nodes(stereo, fem, compare)


def awaited(experiment_has_probe: bool, nodes: Nodes) -> tuple[tuple[str, ...], ...]:
    """Groups of topics; of each group one must come."""
    groups: list[tuple[str, ...]] = []
    if nodes.stereo is not None:
        groups += [(t.LEFT_IMAGE, t.LEFT_COMPRESSED), (t.RIGHT_IMAGE, t.RIGHT_COMPRESSED)]
    else:
        groups += [(t.STEREO_MARKERS, t.STEREO_SURFACE)]
    if nodes.fem is None:
        groups += [(t.FEM_MARKERS,)]
    elif experiment_has_probe:
        groups += [(t.PROBE_POSE,)]
    return tuple(groups)


def _listen(graph: g.Graph, nodes: Nodes, recorder: RunRecorder, watch: LiveWatch, tell: Tell) -> dict[str, Any]:
    """Spin until interrupted, and then until what has arrived is worked on; return the counts."""
    several: dict[str, int] = {}
    with stopped_at_once(graph.stop, tell):  # also where two signals come together, as a service's manager sends them
        _hear(graph, nodes, recorder, watch, several, tell)
        graph.drain(PATIENCE)
        wait_for(graph, nodes)
        graph.finish(PATIENCE)
    graph.join()
    heard = {topic: n for topic, n in recorder.counts.items() if topic in t.TOPICS and t.TOPICS[topic].input}
    traffic = {"lost_messages": graph.lost(), "traffic": graph.balance()}
    return nodes.counts() | traffic | {"inputs": heard, "publishers": several}


def _hear(
    graph: g.Graph, nodes: Nodes, recorder: RunRecorder, watch: LiveWatch, several: dict[str, int], tell: Tell
) -> None:
    """Spin until interrupted; say what is missing or wrong, and every few seconds how it goes. ``several``: the most
    publishers that a topic had, where it had more than one."""
    groups = awaited(nodes.fem is not None and nodes.fem.experiment.probe is not None, nodes)
    tell("press Ctrl-C to end")
    said, moment = "", 0.0
    while not graph.stop:
        graph.spin_until(time.monotonic() + 0.5)
        for topic, n in graph.crowded().items():
            if n > several.get(topic, 1):
                several[topic] = n
                tell(f"warning: {_several(topic, n).text}")
        for finding in watch.news():
            word = "error" if finding.level == "ERROR" else "warning"
            tell(f"{word}: {finding.text}" + (f"; {finding.remedy}" if finding.remedy else ""))
        missing = [group[0] for group in groups if not any(recorder.counts[topic] for topic in group)]
        if missing:
            there = [f"{topic} ({graph.publishers(topic)} publishers)" for topic in missing]
            text = f"waiting for {', '.join(there)}"
        else:
            text = f"recording, {recorder.counts[t.COMPARE_MARKERS]} frames compared" + _said_of_model(nodes)
        if text != said and (missing or time.monotonic() - moment > SAY_EVERY):
            tell(text)
            said, moment = text, time.monotonic()
