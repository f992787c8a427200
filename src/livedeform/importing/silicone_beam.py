"""The published silicone beam (Dubied et al., RA-L 2022; github.com/srl-ethz/diffPD_sim2real) as experiments with bags.

Frame: x along the beam, clamped at x = -0.1 m and free at x = 0; z up; cross-section y and z in [0, 0.03] m. The beam
is held level, and released. What the authors state is here as constants; where the markers really sit, and when the
beam was released, is found in the takes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from livedeform.common.errors import InputError
from livedeform.common.experiment.markers_file import write_markers
from livedeform.common.experiment.schema import Markers
from livedeform.common.types import Array
from livedeform.fem_node.mesh.generate import write_mesh
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.importing.c3d import MotionCapture, read_c3d, register, rest_positions, still_covariance, write_take

LABELS = ("Tip - 1", "Tip - 2", "Tip - 3", "Base - 1", "Base - 2", "Base - 3")
PLACES = np.array(  # m, as the authors state them; the spheres' centres are 6 mm off the surface, placed by hand
    [
        [0.0, 0.015, 0.036],
        [0.0, -0.006, 0.024],
        [0.0, 0.036, 0.006],
        [-0.094, -0.010, -0.001],
        [-0.094, 0.040, 0.0275],
        [-0.094, 0.040, 0.0],
    ]
)
KINDS = np.array(["surface"] * 3 + ["support"] * 3)
TIP = slice(0, 3)
IDS = np.arange(1, 7, dtype=np.uint32)
NEXT_IDS = 10  # from one load case's ids to the next one's: the markers were placed anew
BOTH = "both"  # the experiment with the takes of all load cases

SIZE = (0.1, 0.03, 0.03)  # m
GRAVITY = 9.80709  # m/s2, this and the next four as the authors state them
DENSITY = 1070.0
POISSON_RATIO = 0.499
YOUNGS_MODULUS = 263824.0
TIP_WEIGHT = 0.51012  # N
ELEMENT_SIZE = 0.006
VERDICT = 0.002  # m

AUTHORS_FEM = {  # m, static end places of PLACES' feet on the surface, by a commercial FEM at YOUNGS_MODULUS
    "gravity": np.array([[1.0147, 15.001, 23.226], [0.51624, -0.001, 17.248], [-0.96361, 30.000, -0.69132]]) * 1e-3,
    "load52": np.array([[2.0836, 15.015, 12.669], [0.46708, -0.10591, 7.1591], [-3.4292, 30.016, -10.282]]) * 1e-3,
}
AUTHORS_POINTS = np.array([[0.0, 15.0, 30.0], [0.0, 0.0, 24.0], [0.0, 30.0, 6.0]]) * 1e-3  # m, where these begin

SETTLING = 0.2  # s: the tracker's filter moves still markers by up to 0.5 mm during the first 0.15 s
MOTION = 0.3e-3  # m: thirty times the noise of the tip's mean
SWINGS = 0.5, 1.5  # s after it moved, over which the tip's mean is about where it comes to rest
END = 1.0  # s: the ringing has died, and creep is slower than a take differs from the next
FALLS = 0.0005, 0.005  # m of the tip's fall in which the beam hardly holds it back yet
LAG = 0.028  # of a period: 3.9 and 6.1 ms of 129 and 235 ms where the model was let go at a known time
RELEASE_SIGMA = 0.003  # s: by which a hand's release, told by the phase of later swings, and a sudden one differ
REST_BEFORE_RELEASE = 0.2  # s of rest that is kept in the recording


@dataclass(frozen=True)
class BeamTake:
    """One take: the first frame in which it moves, when it was ``release``d (s after that frame, so below 0),
    T_phantom_tracker, and how well the stated places fit."""

    name: str
    capture: MotionCapture
    release_frame: int
    release: float
    T_phantom_tracker: Array
    misfit: Array  # (6, 3) m, rest place minus stated place


def release_of(take: MotionCapture) -> tuple[int, float]:
    """Return the first frame in which the tip has moved by ``MOTION`` from where it rested after the tracker settled,
    and when it was released, s after that frame.

    A hand lets go over some hundredths of a second, so the release is the sudden one that leads to the same swing: a
    damped oscillator passes its rest (T / 2 pi)(pi/2 + zeta) after it was let go, T from its later passages and zeta
    from the first peaks, and a beam that relaxes and has more than one mode `LAG` T later. What hangs on the beam may
    pull later than its own weight, and then that phase tells neither: such a beam was let go when its tip began to
    fall freely.
    """
    settled = take.frames_between(SETTLING, SETTLING + 0.1)
    if len(settled) == 0 or not np.isfinite(take.points[:, TIP]).any():
        raise InputError(
            f"ends before the tracker has settled ({len(take.points) / take.rate_hz:.2f} s)",
            where=str(take.path),
            remedy="get the take again, it may be torn",
        )
    tip = np.nanmean(take.points[:, TIP], axis=1)
    away = tip - np.median(tip[settled], axis=0)
    moved = np.linalg.norm(away, axis=1) > MOTION
    moved[: settled[-1] + 1] = False
    if not moved.any():
        raise InputError(
            "the tip never moves", where=str(take.path), remedy="give a take in which the beam is released"
        )
    first = int(np.flatnonzero(moved)[0])
    if any(loads_of(case) and case in take.path.stem for case in AUTHORS_FEM):
        return first, _fell(away[first:], take.rate_hz)
    return first, _let_go(away[first:], take.rate_hz)


def _fell(away: Array, rate_hz: float) -> float:
    """Return when (s) what is ``away`` (f, 3) m from its start began to fall freely; 0 where it never falls so far."""
    fall = np.linalg.norm(away, axis=1)
    end = int(np.argmax(fall > FALLS[1]))
    at = np.flatnonzero(fall[:end] > FALLS[0])
    return float(np.mean(at / rate_hz - np.sqrt(2.0 * fall[at] / GRAVITY))) if len(at) else 0.0


def _let_go(away: Array, rate_hz: float) -> float:
    """Return when (s) what is ``away`` (f, 3) m from its start was let go, see `release_of`."""
    middle = away[round(SWINGS[0] * rate_hz) : round(SWINGS[1] * rate_hz)].mean(axis=0)
    path = away @ middle / (middle @ middle) - 1.0  # -1 where it was held, 0 where it comes to rest
    before = np.flatnonzero((path[1:] >= 0.0) != (path[:-1] >= 0.0))[:5]
    passes = before - path[before] / (path[before + 1] - path[before])
    if len(passes) < 5:
        return 0.0  # it does not swing
    peaks = [np.abs(path[i : j + 1]).max() for i, j in pairwise(before)]
    zeta = np.log(peaks[0] / peaks[2]) / (2.0 * np.pi)
    period = passes[4] - passes[2]
    return float((passes[0] - period * (0.25 + zeta / (2.0 * np.pi) + LAG)) / rate_hz)


def read_take(path: Path) -> BeamTake:
    """A take, registered by a rigid fit of all six stated places to the markers at rest before the release."""
    capture = read_c3d(path)
    if capture.labels != LABELS:
        raise InputError(
            f"the markers are {', '.join(capture.labels)}",
            where=str(path),
            remedy="this preset is for the beam's takes only",
        )
    first, release = release_of(capture)
    rest = rest_positions(capture, np.arange(round(SETTLING * capture.rate_hz), first - 2))
    T, misfit = register(PLACES, rest)
    return BeamTake(path.stem, capture, first, release, T, misfit)


def import_beam(files: list[Path], surface: Path, out: Path, mesh: TetMesh | None = None) -> list[Path]:
    """Writes ``out/gravity`` and ``out/load52``, each an experiment with its takes as ``bags/<take>.mcap``, and
    ``out/both`` with all of them, where they are there; with a ``mesh`` it takes that instead of the surface.

    Gives the experiments' folders. A take belongs to the load case that its name contains.
    """
    experiments = takes_of(files)
    if not experiments:
        raise InputError(
            "no take is named after a load case",
            where=", ".join(map(str, files)),
            remedy="names contain gravity or load52",
        )
    takes = {path: read_take(path) for paths in experiments.values() for path in paths}
    written = []
    for name, own in experiments.items():
        cases = {case: [takes[path] for path in own if case in path.stem] for case in AUTHORS_FEM}
        loaded = {case: of_case for case, of_case in cases.items() if of_case}
        written.append(_write_experiment(name, loaded, surface, out / name, mesh))
    return written


def takes_of(files: Sequence[Path]) -> dict[str, list[Path]]:
    """Return which of the ``files`` belong to which experiment: each load case's, and those of `BOTH` if there are
    several cases."""
    cases = {case: [path for path in files if case in path.stem] for case in AUTHORS_FEM}
    found = {case: paths for case, paths in cases.items() if paths}
    return found | ({BOTH: [path for paths in found.values() for path in paths]} if len(found) > 1 else {})


def reference_markers(takes: list[BeamTake]) -> Markers:
    """Return where the markers sit on the undeformed beam: at rest, in the mean over the takes.

    They were placed by hand, about 1 mm from the stated places: the takes know better. But the beam was held by hand,
    which is no rest: the sigma is the scatter over takes of where they end, seen from where they began, of the tip's
    and of the base's markers (0.18 and 0.01 mm; with the weight 0.43 and 0.17 mm). What all takes have in common, as a
    beam that is held below its level, is left to `reference_pose`. One take does not know its scatter; the misfit of
    the stated places stands for it.
    """
    misfit = np.array([take.misfit for take in takes])
    spread = misfit[0] ** 2
    if len(takes) > 1:
        spread = np.array([displacement(take) for take in takes]).var(axis=0, ddof=1)
    sigma = np.concatenate([np.full(3, np.sqrt(np.mean(spread[part]))) for part in (TIP, slice(3, 6))])
    return Markers(IDS, PLACES + misfit.mean(axis=0), sigma, KINDS)


def displacement(take: BeamTake) -> Array:
    """Return how far (6, 3) m the markers end, over the last ``END`` s, from where they rested before the release."""
    capture = take.capture
    before = rest_positions(capture, np.arange(round(SETTLING * capture.rate_hz), take.release_frame - 2))
    after = np.nanmean(capture.points[-round(END * capture.rate_hz) :], axis=0)
    return np.asarray((after - before) @ take.T_phantom_tracker[:3, :3].T)


def _write_experiment(
    name: str, cases: Mapping[str, list[BeamTake]], surface: Path, folder: Path, mesh: TetMesh | None
) -> Path:
    """Write one experiment with the takes of these load ``cases``. Each case's markers have ids of their own, and what
    loads the beam stands under `recordings:` where cases differ."""
    (folder / "bags").mkdir(parents=True, exist_ok=True)
    markers = [_with_ids(reference_markers(takes), k) for k, takes in enumerate(cases.values())]
    write_markers(folder / "markers.csv", _joined(markers))
    write_surface(surface, folder / "beam.stl")
    released = {t.name: round(REST_BEFORE_RELEASE + t.release, 4) for takes in cases.values() for t in takes}
    content = description(name, round(float(np.mean(list(released.values()))), 4))
    content["recordings"] = {
        t.name: {"release": released[t.name]} | ({"loads": loads_of(case)} if len(cases) > 1 else {})
        for case, takes in cases.items()
        for t in takes
    }
    if mesh is not None:
        write_mesh(folder / "beam.vtu", mesh)
        body = {k: v for k, v in content["phantom"].items() if k not in ("surface", "element_size")}
        content["phantom"] = {"mesh": "beam.vtu"} | body
    (folder / "experiment.yaml").write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
    for own, takes in zip(markers, cases.values(), strict=True):
        for take in takes:
            _write_take(take, own, folder)
    return folder


def _write_take(take: BeamTake, markers: Markers, folder: Path) -> None:
    """Write a take's bag, registered to the places of its load case's ``markers``."""
    capture = take.capture
    first = take.release_frame - round(REST_BEFORE_RELEASE * capture.rate_hz)
    rest = rest_positions(capture, np.arange(round(SETTLING * capture.rate_hz), take.release_frame - 2))
    T, _ = register(markers.points, rest)  # once more, to the places common to the takes
    write_take(
        capture.cropped(first),
        folder / "bags" / f"{take.name}.mcap",
        ids=markers.ids,
        T_phantom_tracker=T,
        covariance=still_covariance(capture),
        metadata={
            "source": capture.path.name,
            "first_frame": str(first),
            "release_frame": str(take.release_frame),
            "release_s_after_that_frame": f"{take.release:.4f}",
            "registration_rms_mm": f"{1e3 * float(np.sqrt((take.misfit**2).sum(axis=1).mean())):.3f}",
        },
    )


def _with_ids(markers: Markers, case: int) -> Markers:
    """Return the markers with the ids of load case number ``case``."""
    return replace(markers, ids=np.asarray(markers.ids + NEXT_IDS * case, np.uint32))


def _joined(parts: Sequence[Markers]) -> Markers:
    """Return all markers of several load cases."""
    ids, points, sigmas, kinds = (
        np.concatenate([getattr(m, k) for m in parts]) for k in ("ids", "points", "sigmas", "kinds")
    )
    return Markers(ids, points, sigmas, kinds)


def write_surface(source: Path, target: Path) -> None:
    """The beam's STL (mm, long axis z from the clamp) in the beam's frame (m): x = z - 0.1, y = x, z = y."""
    import trimesh

    mesh = trimesh.load_mesh(str(source))
    mesh.vertices = np.roll(np.asarray(mesh.vertices), 1, axis=1) * 1e-3 - [0.1, 0.0, 0.0]
    mesh.export(target)


def description(case: str, release: float = REST_BEFORE_RELEASE) -> dict[str, Any]:
    """``experiment.yaml`` of a load case with the authors' constants; ``release`` s after a recording's start."""
    content: dict[str, Any] = {
        "version": 1,
        "name": f"silicone-beam-{case}",
        "phantom": {
            "surface": "beam.stl",
            "unit": "m",
            "configuration": "unloaded",
            "element_size": ELEMENT_SIZE,
            "density": DENSITY,
            "material": {"model": "neo_hookean", "youngs_modulus": YOUNGS_MODULUS, "poisson_ratio": POISSON_RATIO},
            "gravity": [0.0, 0.0, -GRAVITY],
            "support": [
                {
                    "region": {"plane": {"point": [-0.1, 0.015, 0.015], "normal": [1.0, 0.0, 0.0], "tolerance": 1e-4}},
                    "type": "fixed",
                }
            ],
            "markers": "markers.csv",
        },
        "timeline": {"release": release, "release_sigma": RELEASE_SIGMA},
        "thresholds": {"error": VERDICT},
    }
    if loads := loads_of(case):
        content["loads"] = loads
    return content


def loads_of(case: str) -> list[dict[str, Any]]:
    """Return what loads the beam besides its own weight."""
    if case != "load52":
        return []
    # on the tip's face, along its upper edge: the lever arm is the whole length
    edge = {"box": [[-0.0005, -0.001, 0.024], [0.001, 0.031, 0.031]]}
    return [{"name": "weight", "region": edge, "force": [0.0, 0.0, -TIP_WEIGHT]}]
