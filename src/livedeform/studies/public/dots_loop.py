"""The dot cylinder and the loop: what `closed_loop` says of the dots where the lens's distortion is not applied, or
was never calibrated.

The cameras are calibrated on the even rows of dots, and the loop is fitted to what they then report of these; the odd
rows take part in neither, and are held out. One pair of pictures is one measurement, so a recording holds one frame.
The body is stiff, has no weight, and nothing touches it: whatever the dots are off their places is the cameras' doing.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml
from scipy.spatial.transform import Rotation

from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.loop import diagnose
from livedeform.closed_loop.write import effect_json
from livedeform.common import topics as t
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.experiment.markers_file import write_markers
from livedeform.common.experiment.schema import Markers
from livedeform.common.frames import apply, fit_rigid, matrix_pose, transform
from livedeform.common.types import Array, Ids, MarkerFrame
from livedeform.compare_node.metrics import rmse
from livedeform.report.page import Table
from livedeform.stereo_node.calibrate.resect import resect, resected_rig
from livedeform.stereo_node.camera.calibration_file import write_camera
from livedeform.stereo_node.camera.rig import StereoRig, make_rig
from livedeform.stereo_node.camera.triangulate import Triangulated, triangulate
from livedeform.studies.public.dots import DETECTOR, HOME, MM, Dots, cylinder, marker_id
from livedeform.studies.study import COLOURS, FAILS, HOLDS, PARTLY, Progress, StudyPage, figure

CANDIDATES = ("lens_distortion", "stereo_scale", "camera_motion")
PRINT_SIGMA = 3e-5  # m: both cameras see the same rows that far off their places, whatever the lens model
SIGMA_PX = 0.07  # of a centroid: how far ours scatter about the published ones (0.03 px across, 0.07 px along)
RADIUS, HEIGHT, SECTIONS, RINGS = 0.057, 0.25, 16, 5  # m; few triangles: nothing moves the body
STAMP_NS = 1_000_000_000
STEPS = np.array([*[1.0] * 8, *[1e-4] * 6, 1e-3])  # of derivatives, see `varied`: px, rad and m, 1


@dataclass(frozen=True)
class Case:
    """Cameras calibrated with the lens ``model``; ``dropped``: their coefficients are then not applied."""

    name: str
    told: str
    model: str
    dropped: bool


DROPPED = Case("dropped", "calibrated with k1 k2, which are not applied", "k1k2", True)
PINHOLE = Case("pinhole", "calibrated without distortion", "none", False)


@dataclass(frozen=True)
class DotsSeen:
    """The dots that both cameras see: ``ids`` (n,), known ``places`` (n, 3) m, ``left`` and ``right`` (n, 2) px."""

    ids: Ids
    places: Array
    left: Array
    right: Array

    @property
    def fitted(self) -> np.ndarray:
        """Those of the even rows (n,), as counted on the cylinder."""
        return np.asarray(self.ids % 2 == 0)


@dataclass(frozen=True)
class DotsDiagnosis:
    """The loop's diagnosis of a case. ``calibrated``: k1 of the left and the right camera; ``one_term``: the k1 that
    alone comes nearest to the calibrated lenses over the fitted dots; ``applied``: rms m of the held-out dots where the
    calibration is applied; ``before``, ``after`` (n,) m of each held-out dot, ``radius`` (n,) its place in the left
    picture, over the focal length."""

    case: Case
    result: Diagnosis
    calibrated: tuple[float, float]
    one_term: float
    applied: float
    before: Array
    after: Array
    radius: Array

    @property
    def k1(self) -> tuple[float, float] | None:
        """Return the value as fitted, with its sigma; None where the loop does not name it."""
        for effect in self.result.effects:
            if effect.name == "lens_distortion":
                return float(effect.values["k1"]), float(effect.sigmas["k1"])
        return None


def seen_by_both(dots: Dots, centroids: tuple[Array, Array]) -> DotsSeen:
    """The dots of the common columns that are found in both pictures."""
    left, right = (
        np.concatenate([pixels[list(columns).index(j)] for j in dots.common])
        for pixels, columns in zip(centroids, dots.columns, strict=True)
    )
    places = np.concatenate([dots.places[:, j] for j in dots.common])
    ids = np.array([marker_id(i, j) for j in dots.common for i in range(len(dots.places))], np.uint32)
    both = np.isfinite(left[:, 0]) & np.isfinite(right[:, 0])
    return DotsSeen(ids[both], places[both], left[both], right[both])


def calibrated_rig(dots: Dots, centroids: tuple[Array, Array], model: str) -> StereoRig:
    """The rig calibrated on the even rows of all columns that each camera sees."""
    views = []
    for columns, pixels in zip(dots.columns, centroids, strict=True):
        X = np.concatenate([dots.places[1::2, j] for j in columns])
        x = pixels[:, 1::2].reshape(-1, 2)
        seen = np.isfinite(x[:, 0])
        views.append(resect(X[seen], x[seen], model))
    height, width = dots.pictures[0].shape
    return resected_rig(views[0], views[1], (width, height))[0]


def without_distortion(rig: StereoRig) -> StereoRig:
    """The rig whose files hold no distortion: the rest of the calibration stays."""
    return StereoRig(*(replace(c, dist_coeffs=np.zeros_like(c.dist_coeffs)) for c in (rig.left, rig.right)))


def measure(rig: StereoRig, seen: DotsSeen) -> tuple[Array, Triangulated]:
    """T_phantom_left (4, 4), registered on the fitted dots at rest, and all dots in the left frame."""
    points = triangulate(rig, seen.left, seen.right, sigma_px=SIGMA_PX)
    return fit_rigid(points.points[seen.fitted], seen.places[seen.fitted]), points


def one_term(rig: StereoRig, in_left: Array) -> float:
    """The k that minimises the sum of |x (k r^2 - k1 r^2 - k2 r^4)|^2 over the points (n, 3) m in both cameras."""
    above = below = 0.0
    for camera, X in ((rig.left, in_left), (rig.right, apply(rig.T_right_left, in_left))):
        r2 = ((X[:, :2] / X[:, 2:]) ** 2).sum(axis=1)
        k1, k2 = camera.dist_coeffs[:2]
        above, below = above + float((k1 * r2**3 + k2 * r2**4).sum()), below + float((r2**3).sum())
    return above / below


def write_case(folder: Path, rig: StereoRig, seen: DotsSeen) -> tuple[Path, Path, Path]:
    """The experiment, and a recording each of the fitted and of the held-out dots: what the ``rig`` reports."""
    folder.mkdir(parents=True, exist_ok=True)
    z = np.linspace(0.0, HEIGHT, RINGS + 1)
    outline = np.r_[[[0.0, 0.0]], np.column_stack([np.full(len(z), RADIUS), z]), [[0.0, HEIGHT]]]
    trimesh.creation.revolve(outline, sections=SECTIONS).export(folder / "cylinder.stl")
    write_camera(rig.left, folder / "left.yaml")
    write_camera(rig.right, folder / "right.yaml")
    n = len(seen.ids)
    write_markers(
        folder / "markers.csv", Markers(seen.ids, seen.places, np.full(n, PRINT_SIGMA), np.full(n, "surface"))
    )
    document = {
        "version": 1,
        "name": "dot-cylinder",
        "phantom": cylinder(HEIGHT / RINGS, 1.0e9, 0.3),
        "stereo": {"left": "left.yaml", "right": "right.yaml", "pose": "registered", "detector": DETECTOR},
        "thresholds": {"error": 0.001},
    }
    (folder / "experiment.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    T, measured = measure(rig, seen)
    covariances = T[:3, :3] @ measured.covariances @ T[:3, :3].T
    bags = folder / "even_rows.mcap", folder / "odd_rows.mcap"
    for bag, rows in zip(bags, (seen.fitted, ~seen.fitted), strict=True):
        with BagWriter(bag, {"source": HOME}) as writer:
            recording = RecordingWriter(writer)
            recording.static_transforms({(t.FRAME_PHANTOM, t.FRAME_LEFT): matrix_pose(T, STAMP_NS)}, STAMP_NS)
            recording.marker_frame(
                MarkerFrame(
                    STAMP_NS,
                    seen.ids[rows],
                    apply(T, measured.points[rows]),
                    covariances[rows],
                    measured.reprojection_error_px[rows],
                )
            )
    return folder / "experiment.yaml", *bags


def ask(dots: Dots, centroids: tuple[Array, Array], case: Case, out: Path, progress: Progress) -> DotsDiagnosis:
    """Return what the loop says of a case; files in the folder ``out``."""
    seen = seen_by_both(dots, centroids)
    calibrated = calibrated_rig(dots, centroids, case.model)
    rig = without_distortion(calibrated) if case.dropped else calibrated
    experiment, fit, test = write_case(out, rig, seen)
    result = diagnose(
        experiment, [fit], [test], out / "diagnosis", candidates=CANDIDATES, processes=1, progress=progress
    )
    before, after = (errors.size[0] for errors in (result.errors_before, result.errors_after))
    held = [int(i) for i in result.held_out[0].ids]
    row = np.array([held.index(int(i)) for i in seen.ids[~seen.fitted]])
    T, measured = measure(calibrated, seen)
    off = np.linalg.norm(apply(T, measured.points) - seen.places, axis=1)[~seen.fitted]
    x = measured.points[:, :2] / measured.points[:, 2:]
    k1 = tuple(float(c.dist_coeffs[0]) for c in (calibrated.left, calibrated.right))
    return DotsDiagnosis(
        case,
        result,
        (k1[0], k1[1]),
        one_term(calibrated, measured.points[seen.fitted]),
        rmse(off),
        before[row],
        after[row],
        np.linalg.norm(x[~seen.fitted], axis=1),
    )


# --- where a calibration without distortion puts it -------------------------------------------------------------------


def hidden_shares(rig: StereoRig, seen: DotsSeen) -> dict[str, float]:
    """Shares of the squared errors of the held-out dots that each set of columns takes away beyond a rigid motion,
    fitted to the other dots; to first order at the ``rig``.

    ``lens``: k1, the same in both cameras; ``calibration``: what a calibration without distortion fits, focal lengths
    and principal points of both cameras and the pose between them; ``both``.
    """
    T, _ = measure(rig, seen)

    def places(p: Array) -> Array:
        return apply(T, triangulate(varied(rig, p), seen.left, seen.right).points)

    steps = np.diag(STEPS)
    columns = [places(step) - places(-step) for step in steps]
    error = places(np.zeros(len(STEPS))) - seen.places
    arm = seen.places - seen.places.mean(axis=0)
    rigid = [np.broadcast_to(e, arm.shape) for e in np.eye(3)] + [np.cross(e, arm) for e in np.eye(3)]

    def left_of(chosen: Sequence[Array]) -> float:
        A = np.stack([*rigid, *chosen], axis=-1)
        A = A / np.linalg.norm(A, axis=(0, 1))
        theta = np.linalg.lstsq(A[seen.fitted].reshape(-1, A.shape[-1]), error[seen.fitted].ravel(), rcond=1e-10)[0]
        return float(((error - A @ theta)[~seen.fitted] ** 2).sum())

    sets = {"lens": columns[-1:], "calibration": columns[:-1], "both": columns}
    return {name: 1.0 - left_of(chosen) / left_of([]) for name, chosen in sets.items()}


def varied(rig: StereoRig, p: Array) -> StereoRig:
    """The rig with ``p`` (15,) added: fx fy cx cy px of the left and of the right camera, a turn rad and a shift m of
    the right one, and k1 of both."""
    cameras = []
    for side, camera in enumerate((rig.left, rig.right)):
        matrix, coefficients = camera.camera_matrix.copy(), camera.dist_coeffs.copy()
        matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += p[4 * side : 4 * side + 4]
        coefficients[0] += p[14]
        cameras.append((camera.name, camera.width, camera.height, matrix, coefficients, camera.distortion_model))
    moved = transform(Rotation.from_rotvec(p[8:11]).as_matrix(), p[11:14])
    return make_rig(cameras[0], cameras[1], moved @ rig.T_right_left)


# --- the page ---------------------------------------------------------------------------------------------------------


def add_to_page(page: StudyPage, dots: Dots, centroids: tuple[Array, Array], progress: Progress) -> None:
    """Both cases: claims, numbers, a table and a figure."""
    if (page.out / "loop").exists():
        shutil.rmtree(page.out / "loop")
    diagnoses = [ask(dots, centroids, case, page.out / "loop" / case.name, progress) for case in (DROPPED, PINHOLE)]
    shares = hidden_shares(calibrated_rig(dots, centroids, PINHOLE.model), seen_by_both(dots, centroids))
    page.numbers["loop"] = {a.case.name: numbers_of(a) for a in diagnoses} | {"pinhole_shares": shares}
    for found in diagnoses:
        page.claim(*claim_of(found, shares))
    header = ("cameras", "verdict", "k1 fitted", "k1 calibrated", "before mm", "after mm", "calibrated mm", "noise mm")
    page.section(
        "What the loop says",
        [
            "Cameras calibrated on the even rows; the loop is fitted to what they report of these, with the candidates "
            f"{', '.join(CANDIDATES)}, and judged on the odd rows. Rms of the held-out dots, registered: before and "
            "after the diagnosis, with the calibration applied, and of the centroids' noise. "
            f"One k1 alone comes nearest to the calibrated k1 k2 at {diagnoses[0].one_term:.3f}.",
            *(f"{a.case.told}: {a.result.text}" for a in diagnoses),
            "Of the squared error of the held-out dots that the calibration without distortion leaves, a k1 alone "
            f"takes away {100 * shares['lens']:.0f} %, other focal lengths, principal points and camera poses "
            f"{100 * shares['calibration']:.0f} %, all of them together {100 * shares['both']:.0f} % (linear, fitted "
            "to the even rows).",
        ],
        [("loop", _figure(diagnoses), "Error of each held-out dot by its distance from the left picture's middle.")],
        [Table(header, tuple(row_of(a) for a in diagnoses), tuple(range(2, 8)))],
    )
    page.limits.append(
        "The loop is given the dots by their published names: it looks for the cause of an error, not for the dots. "
        "One pair of pictures is one measurement; nothing here repeats it."
    )


def numbers_of(a: DotsDiagnosis) -> dict[str, Any]:
    """Return what ``study.json`` holds, in SI units."""
    return {
        "verdict": a.result.verdict,
        "effects": [effect_json(e) for e in a.result.effects],
        "k1_calibrated": a.calibrated,
        "k1_one_term": a.one_term,
        "held_out_n": len(a.before),
        "held_out_rms_before": a.result.before.rmse,
        "held_out_rms_after": a.result.after.rmse,
        "held_out_rms_calibrated": a.applied,
        "noise_floor": a.result.floor,
        "explained": a.result.explained,
        "candidates": {
            r.name: {"gain": r.gain, "score": r.score, "held_out_rms": r.test_rmse} for r in a.result.ranking
        },
        "text": a.result.text,
    }


def row_of(a: DotsDiagnosis) -> tuple[str, ...]:
    """Return the row of the page's table."""
    named = ", ".join(e.name for e in a.result.effects)
    k1 = f"{a.k1[0]:.4f} +- {a.k1[1]:.4f}" if a.k1 else "-"
    calibrated = "none" if a.case.model == "none" else "{:.3f}, {:.3f}".format(*a.calibrated)
    lengths = (a.result.before.rmse, a.result.after.rmse, a.applied, a.result.floor)
    verdict = a.result.verdict + (f": {named}" if named else "")
    return (a.case.told, verdict, k1, calibrated, *(f"{x * MM:.3f}" for x in lengths))


def claim_of(a: DotsDiagnosis, shares: Mapping[str, float]) -> tuple[str, str, str, str, str]:
    """Return whether the loop names the distortion, and why not where it is hidden (see `hidden_shares`)."""
    before, after = a.result.before.rmse * MM, a.result.after.rmse * MM
    if a.k1 is None:
        nearest = ", ".join(added.candidate.name for added in a.result.added) or "none"
        ours = f"{a.result.verdict} (nearest: {nearest}); held-out dots {before:.3f} mm"
    else:
        names = ", ".join(e.name for e in a.result.effects)
        ours = f"{a.result.verdict}: {names}, k1 {a.k1[0]:.3f}; held-out dots {before:.3f} mm before, {after:.3f} after"
    why = f"one k1 alone comes nearest to the calibrated lenses at {a.one_term:.3f}"
    if not a.case.dropped:
        why = (
            f"k1 alone takes away {100 * shares['lens']:.0f} % of the squared error, other cameras "
            f"{100 * shares['calibration']:.0f} %, both {100 * shares['both']:.0f} %: the calibration hides it"
        )
    verdict = FAILS if a.k1 is None else HOLDS if len(a.result.effects) == 1 else PARTLY
    return f"the loop names the distortion; cameras {a.case.told}", "", ours, verdict, why


def _figure(diagnoses: Sequence[DotsDiagnosis]) -> Any:
    fig, axes = figure(6.4, 3.0, len(diagnoses), sharex=True)
    for axis, a in zip(axes, diagnoses, strict=True):
        axis.plot(a.radius, a.before * MM, "o", color=COLOURS[1], alpha=0.7, label="before")
        if a.result.verdict == "effect":
            axis.plot(a.radius, a.after * MM, "o", color=COLOURS[0], alpha=0.7, label="after")
        axis.axhline(a.applied * MM, color="0.4", lw=1.0, label="rms as calibrated")
        axis.set_title(f"{a.case.name}: {a.result.verdict}")
        axis.set_xlabel("distance from the middle / focal length")
        axis.set_ylim(bottom=0.0)
    axes[0].set_ylabel("distance from the known place (mm)")
    axes[0].legend(loc="upper left")
    return fig
