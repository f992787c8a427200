"""Does a recording serve an experiment? Each check is a function of both that gives findings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from livedeform.common import topics as t
from livedeform.common.bags.recording import Recording, load_recording
from livedeform.common.checks.arrangement import check_arrangement, radius_of
from livedeform.common.checks.beginning import check_beginning
from livedeform.common.checks.clocks import check_clocks
from livedeform.common.checks.contact.first_motion import check_first_motion
from livedeform.common.checks.contact.pushing import check_pushing
from livedeform.common.checks.declared import check_declared
from livedeform.common.checks.exchanged import check_exchanged
from livedeform.common.checks.finding import Finding, Severity, refuse_errors
from livedeform.common.checks.probe_path import ProbeRecord, check_probe
from livedeform.common.checks.tared import check_tared
from livedeform.common.errors import InputError
from livedeform.common.experiment.plausibility import read_body
from livedeform.common.experiment.schema import Experiment
from livedeform.common.experiment.surface import Surface
from livedeform.common.published_effects import impossible
from livedeform.common.types import Array, MarkerFrame

FAR_FROM_REFERENCE = 1.0  # of the body's radius: markers that far from their places are in another frame or unit
OUTSIDE_ALL, OUTSIDE_MANY = 0.99, 0.05  # shares of measured moments outside the time of the poses
POSES_APART_NS = 500_000_000  # poses further apart are not interpolated, nor are their predictions
SAME = 0.5  # share of equal poses from which two recordings are one


def check_recording(recording: Recording, experiment: Experiment, *, is_part: bool = False) -> list[Finding]:
    """Everything that can be told from the recording's numbers, without its pictures, and of what is declared. Of one
    that ``is_part`` of a longer one who has that tells how it begins (`check_start`), and whether the probe touches."""
    body = read_body(experiment)
    checks: Sequence[Callable[[Recording, Experiment, Surface], list[Finding]]] = (
        check_faults, check_frames, check_ids, check_inputs, check_stamps, check_gaps, check_exchanges,
        check_clocks, check_release, check_drifts,
    )  # fmt: skip
    found = [finding for check in checks for finding in check(recording, experiment, body)]
    probe = ProbeRecord(recording, experiment, body)
    of_probe = [
        check_places,
        *([] if is_part else [check_probe, check_beginning, check_first_motion]),
        check_tared,
        check_pushing,
    ]
    found += [finding for check in of_probe for finding in check(probe)]
    return [*found, *check_declared(experiment, body)]


def check_named(recording: Recording, experiment: Experiment) -> list[Finding]:
    """Say what lines of ``recordings`` declare of it; where there are lines and none fits, one may be mistyped."""
    if not experiment.recordings:
        return []
    if said := experiment.overrides(recording.own_name):
        text = "; ".join(override.text for override in said)
        return [Finding("NOTE", f"declared of '{recording.own_name}' alone: {text}")]
    named = list(experiment.recordings)
    shown = ", ".join(named[:4]) + (f" and {len(named) - 4} more" if len(named) > 4 else "")
    text = f"no line of recordings ({shown}) fits '{recording.own_name}': what is declared for all acts in it"
    return [Finding("WARN", text, "correct the line's name, if one is meant for it")]


def check_inputs(recording: Recording, experiment: Experiment, body: Surface) -> list[Finding]:
    """Check whether what the experiment needs was recorded."""
    found = []
    frames = recording.measured_frames
    if frames and not any(len(frame.ids) for frame in frames):
        text = f"no frame of {t.STEREO_MARKERS} holds a marker of the experiment with finite coordinates"
        found.append(Finding("ERROR", text, "check the tracker, and the ids in markers.csv"))
    if experiment.probe is not None and not recording.poses:
        text = f"the experiment has a probe, but there is no {t.PROBE_POSE}"
        found.append(Finding("ERROR", text, "record the poses, or take the section 'probe' out of the experiment"))
    if experiment.probe is None and recording.poses:
        found.append(Finding("WARN", f"{t.PROBE_POSE} is not used: the experiment has no probe", doubts=True))
    return found


FAULTS: dict[str, tuple[Severity, str, str]] = {
    "no_id": ("ERROR", f"{t.STEREO_MARKERS} has no field 'id': nothing says which marker is which",
              "record PointCloud2 with the fields x, y, z and id"),
    "covariance": ("WARN", "covariances that are zero, negative, infinite or incomplete are taken as unknown",
                   "correct the tracker's covariances, or leave all six fields out"),
    "stamp": ("WARN", "messages whose stamp cannot be right are left out", "check the clocks"),
    "stretch": ("WARN", "messages whose stamp cannot be right are left out, several in a row",
                "record again, with clocks that are set before"),
    "pause": ("NOTE", "pauses of more than an hour: the body is taken to be as old as the stamps say", ""),
    "twice": ("WARN", "markers whose id is there twice in a frame are left out: nobody knows which is which",
              "give every marker its own id"),
    "cameras_moved": ("WARN", f"{t.TF_STATIC} says anew where the cameras are: the last place counts for all",
                      "record again, with cameras that stay, or part the recording there"),
    "quaternion": ("WARN", "poses whose orientation is no rotation are left out", "check the robot's poses"),
    "not_finite": ("NOTE", "markers whose coordinates are not finite are left out", ""),
    "norm": ("WARN", "poses whose quaternion's norm is not 1 are taken for the rotation that it is a multiple of",
             "record a unit quaternion x, y, z, w; angles are none"),
    "set_back": ("WARN", "clocks were set back meanwhile: moments before and after lie between each other",
                 "record again, with clocks that nobody sets"),
    "unset": ("ERROR", "every stamp is 0", "set header.stamp when recording"),
}  # fmt: skip
"""Counted by ``load_recording``: level, what, remedy."""
DOUBTFUL = {"norm", "set_back", "stretch", "twice", "cameras_moved"}  # faults that may spoil what is concluded


def check_faults(recording: Recording, experiment: Experiment, body: Surface) -> list[Finding]:
    """Report what had to be left out or taken as something else while the recording was read."""
    found = []
    for name, (level, text, remedy) in FAULTS.items():
        n = recording.faults.get(name, 0)
        if n:
            said = text if level == "ERROR" else f"{text} ({n})"
            found.append(Finding(level, said, remedy, doubts=name in DOUBTFUL))
    return found


def check_frames(recording: Recording, experiment: Experiment, body: Surface) -> list[Finding]:
    """Check whether what is measured is said to be in the phantom's frame."""
    return [other_frame(topic, frame) for topic, frame in recording.other_frames.items()]


def other_frame(topic: str, frame: str) -> Finding:
    """Doubt a topic that says to be in another frame."""
    text = f"{topic} is in the frame '{frame}', and taken to be '{t.FRAME_PHANTOM}'"
    return Finding("WARN", text, "record it in the phantom's frame", doubts=True)


def check_stamps(recording: Recording, experiment: Experiment, body: Surface) -> list[Finding]:
    """Check whether the poses cover the measured moments."""
    stamps = np.array([frame.stamp_ns for frame in recording.measured_frames] or recording.picture_stamps_ns)
    if not len(stamps) or not recording.poses or experiment.probe is None:
        return []
    first, last = recording.poses[0].stamp_ns, recording.poses[-1].stamp_ns
    outside = int(((stamps < first) | (stamps > last)).sum())
    share = outside / len(stamps)
    if not outside:
        return []
    text = f"{outside} of {len(stamps)} measured moments lie outside the time of the probe's poses"
    if share > OUTSIDE_ALL:
        return [Finding("ERROR", text + ": the clocks differ", "set both clocks by NTP, and record again")]
    return [Finding("WARN" if share > OUTSIDE_MANY else "NOTE", text)]


def check_gaps(recording: Recording, experiment: Experiment, body: Surface) -> list[Finding]:
    """Check whether measured moments lie between poses that nobody interpolates."""
    stamps = np.array([frame.stamp_ns for frame in recording.measured_frames] or recording.picture_stamps_ns)
    poses = np.sort([pose.stamp_ns for pose in recording.poses])
    if not len(stamps) or len(poses) < 2 or experiment.probe is None:
        return []
    wide = np.diff(poses) > POSES_APART_NS
    begin, end = poses[:-1][wide], poses[1:][wide]
    share = float((end.clip(max=stamps.max()) - begin.clip(min=stamps.min())).clip(0).sum() / max(np.ptp(stamps), 1))
    if share == 0.0:
        return []
    text = (
        f"for {100 * share:.0f} % of the time the probe's poses are more than {1e-9 * POSES_APART_NS:g} s apart (up to "
        f"{1e-9 * (end - begin).max():.3g} s): what is measured between them is not compared"
    )
    remedy = "record poses more often, or write those in between where it moved straight"
    return [Finding("WARN" if share > OUTSIDE_MANY else "NOTE", text, remedy)]


def check_ids(recording: Recording, experiment: Experiment, body: Surface) -> list[Finding]:
    """Markers that the experiment does not know, and those that are never seen."""
    frames = recording.measured_frames
    if not frames:
        return []
    seen = set(np.concatenate([frame.ids for frame in frames]).tolist()) | set(recording.unknown_ids)
    known = set(experiment.markers.ids.tolist())
    unknown, missing = sorted(seen - known), sorted(known - seen)
    found = []
    if unknown:
        level: Severity = "ERROR" if len(unknown) == len(seen) else "WARN"
        remedy = "number the markers as markers.csv does"
        found.append(Finding(level, f"markers {_some(unknown)} are not in the experiment", remedy))
    if missing and seen - set(unknown):
        found.append(Finding("WARN", f"markers {_some(missing)} of the experiment are never seen"))
    return found


def check_places(probe: ProbeRecord) -> list[Finding]:
    """Check whether the markers are where the experiment has them, as far as the body's radius, and what is wrong with
    their ids, their frame or their unit if they are not (`check_arrangement`)."""
    away = _away(probe.recording.measured_frames, probe.experiment)
    away = away[np.isfinite(away)]
    if not len(away):
        return []
    arranged = check_arrangement(probe)
    limit = FAR_FROM_REFERENCE * radius_of(probe.body)
    far = int((away > limit).sum())
    if away[0] <= limit and not far:
        text = f"when first seen, the markers are {1e3 * away[0]:.3f} mm from their places (median)"
        return [Finding("NOTE", text), *arranged]
    if far > 0.5 * len(away) or far == len(away):
        text = f"when first seen, the markers are {away[0]:.3g} m from their places (median): another frame or unit"
        if not arranged:
            return [Finding("ERROR", text, "give markers in metres, in the frame of markers.csv")]
        return [Finding("ERROR", f"{text}, or other ids: {arranged[0].text}", arranged[0].remedy)]
    text = f"in {far} of {len(away)} frames the markers are far from their places (up to {away.max():.3g} m)"
    return [Finding("WARN", text, "check the tracker: another unit or frame in between?", doubts=True), *arranged]


def check_exchanges(recording: Recording, experiment: Experiment, body: Surface) -> list[Finding]:
    """Check whether the markers keep their ids."""
    return check_exchanged(recording.measured_frames, recording.start_ns)


def _away(frames: Sequence[MarkerFrame], experiment: Experiment) -> Array:
    """Median distances (f,) m of the frames' markers from their declared places; NaN of none."""
    markers, out = experiment.markers, np.full(len(frames), np.nan)
    if not frames or not len(markers.ids):
        return out
    ids, order = np.concatenate([frame.ids for frame in frames]), np.argsort(markers.ids)
    column = order[np.minimum(np.searchsorted(markers.ids, ids, sorter=order), len(order) - 1)]
    d = np.linalg.norm(np.concatenate([frame.points for frame in frames]) - markers.points[column], axis=1)
    row = np.repeat(np.arange(len(frames)), [len(frame.ids) for frame in frames])
    known = (markers.ids[column] == ids) & np.isfinite(d)
    row, d = row[known], d[known]
    d = d[np.lexsort((d, row))]
    n = np.bincount(row, minlength=len(frames))
    begin, some = np.cumsum(n) - n, n > 0
    out[some] = 0.5 * (d[(begin + (n - 1) // 2)[some]] + d[(begin + n // 2)[some]])
    return out


def check_release(recording: Recording, experiment: Experiment, body: Surface) -> list[Finding]:
    """Check whether the body is released within the recording."""
    release, lasts = experiment.timeline.release, (recording.end_ns - recording.start_ns) * 1e-9
    if not release or release <= lasts:
        return []
    text = f"timeline.release is at {release:g} s, but the recording lasts {lasts:.3g} s"
    return [Finding("ERROR", text, "correct timeline.release")]


def check_drifts(recording: Recording, experiment: Experiment, body: Surface) -> list[Finding]:
    """Check whether the body is there from the recording's start to its end, by the drifts' clock."""
    if not recording.end_ns:  # no stamp is known
        return []
    declared, height = experiment.timeline.clock_start_ns, float(body.upper[2] - body.lower[2])
    clock_ns = recording.start_ns if declared is None else declared
    times = [1e-9 * (stamp_ns - clock_ns) for stamp_ns in (recording.start_ns, recording.end_ns)]
    remedy = "correct the effect's values" + ("" if declared is None else ", or timeline.clock_start_ns")
    said = [[impossible(e.name, e.values, seconds, height) for seconds in times] for e in experiment.effects]
    return [Finding("ERROR", next(filter(None, texts)), remedy) for texts in said if any(texts)]


def load_checked(fit: Sequence[Path], test: Sequence[Path], experiment: Experiment) -> list[Recording]:
    """The recordings of ``fit`` and ``test``, with the warnings of `check_recording` among theirs.

    Raises ``InputError`` for one of which nothing can be concluded, and where two share moments.
    """
    paths, loaded = (*fit, *test), []
    recordings = [load_recording(path, experiment) for path in paths]
    clock = {"clock_start_ns": drifts_clock_ns(experiment, recordings[: len(fit)])}
    experiment = experiment.model_copy(update={"timeline": experiment.timeline.model_copy(update=clock)})
    for path, recording in zip(paths, recordings, strict=True):
        if not recording.measured_frames and not recording.picture_stamps_ns:
            raise InputError(
                f"holds neither {t.STEREO_MARKERS} nor pictures: points without ids say how far surfaces are apart, "
                "and not which point went where",
                where=str(path), remedy="paint some markers, or import points with ids",
            )  # fmt: skip
        acting = experiment.of_recording(recording.own_name)
        findings = [*check_named(recording, experiment), *check_recording(recording, acting)]
        refuse_errors(findings, str(path))
        said = [finding.text for finding in findings if finding.level == "WARN"]
        doubts = [finding.text for finding in findings if finding.doubts and not finding.mended]
        loaded.append(replace(recording, warnings=[*recording.warnings, *said], doubts=doubts))
    refuse_overlap(
        list(zip(fit, loaded[: len(fit)], strict=True)),
        list(zip(test, loaded[len(fit) :], strict=True)),
    )
    return loaded


def drifts_clock_ns(experiment: Experiment, fit: Sequence[Recording]) -> int:
    """Return when the clock of a diagnosis's drifts starts, ns: as declared, or else with the earliest of the
    recordings that are fitted."""
    declared = experiment.timeline.clock_start_ns
    return min(recording.start_ns for recording in fit) if declared is None else declared


def refuse_overlap(fit: Sequence[tuple[Path, Recording]], test: Sequence[tuple[Path, Recording]]) -> None:
    """Raises ``InputError`` where two recordings are the same, or share a part: what was fitted predicts itself."""
    for (one, a), (two, b) in combinations([*fit, *test], 2):
        if one.resolve() == two.resolve() or _shared(a, b):
            both = "--fit and --test" if (one, a) in fit and (two, b) in test else "among the recordings"
            raise InputError(
                f"holds moments of {one} too ({both})",
                where=str(two),
                remedy="name each recording once, and test on one that was not fitted",
            )


def _shared(a: Recording, b: Recording) -> bool:
    """Return whether measured frames, or, where one has none, most poses of the shorter one, are in both."""
    if a.measured_frames and b.measured_frames:
        keys = [
            {(f.stamp_ns, f.points.astype(np.float32).tobytes()) for f in r.measured_frames if len(f.ids)}
            for r in (a, b)
        ]
        return bool(keys[0] & keys[1])
    poses = [{(p.stamp_ns, p.position.tobytes()) for p in r.poses} for r in (a, b)]
    return len(poses[0] & poses[1]) > SAME * max(min(map(len, poses)), 1)


def _some(numbers: Sequence[int]) -> str:
    shown = ", ".join(map(str, numbers[:8]))
    return shown if len(numbers) <= 8 else f"{shown} and {len(numbers) - 8} more"
