"""Heights (thesis 2.2 to 2.4): of measured points, of the model, and of SOFA's exported positions.

The thesis measures a phantom between a top and a bottom point that are picked (2.2, 2.4), and the model between the
highest and the lowest of its particles, which have no noise (2.3). Of n noisy points that would be too large: the
extremes of noise are added to the extremes of the body. The study shows by how much, and what does not have that fault.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.report.page import Table
from livedeform.studies.bodies import cuboid
from livedeform.studies.own.heights import OwnHeights
from livedeform.studies.study import COLOURS, FAILS, HOLDS, Progress, StudyPage, figure
from livedeform.studies.thesis.sofa import SofaPositions, read_sofa_positions
from livedeform.studies.thesis.stereo import LENGTH_SD, POINT_SD

HEIGHT, YOUNG = 0.07, 2896.0  # m, Pa
COUNTS = (2, 4, 8, 16, 32, 64)
SEED, N_DRAWS = 7, 4000
SLICES = 7
SCENE = "They are taken as written in metres with z up; the half width is half of the extent along x."
MM = 1e3


def run(out: Path, data: Path | None, progress: Progress, *, own: OwnHeights | None = None) -> dict[str, Any]:
    """The study; ``data`` may be a SOFA position file (or a folder of ``*_x.txt``) of the user's own, ``own`` heights
    that were measured."""
    page = StudyPage(
        "height",
        "How tall is it?",
        "Two picked points, or highest minus lowest: how wrong is that with noisy points, and how does one read SOFA's "
        "exports?",
        out,
        inputs={
            "cuboid": f"{HEIGHT * MM:g} mm, E = {YOUNG:g} Pa",
            "sigma of a length": f"{LENGTH_SD * MM:g} mm",
            "sigma of a point along it": f"{POINT_SD * MM:.2f} mm",
        },
        seed=SEED,
    )
    if own is not None:
        _own(page, own)
    progress("height: the model", None)
    _noise(page)
    _exports(page, data)
    return page.finish()


def _own(page: StudyPage, own: OwnHeights) -> None:
    """Hold what was measured: the first height, and how it changes."""
    first = own.values[0]
    values = np.array([h.value for h in own.values])
    change = float(values[int(np.argmax(np.abs(values - first.value)))] - first.value)
    part = f"{first.sigma_systematic * MM:.3f} mm" if own.with_calibration else "not known (--cameras)"
    said = f"{first.value * MM:.3f} ± {1.96 * first.sigma * MM:.3f} mm (95 %)"
    page.numbers["own"] = {
        "how": own.how, "value": first.value, "sigma_noise": first.sigma_noise,
        "sigma_systematic": first.sigma_systematic if own.with_calibration else None,
        "seconds": own.seconds.tolist(), "heights": values.tolist(),
    }  # fmt: skip
    rows = (
        ("height, first frame", said),
        ("of that the noise, one sigma", f"{first.sigma_noise * MM:.3f} mm"),
        ("of that the calibration's scale, one sigma", part),
        ("largest change in the recording", f"{change * MM:+.3f} mm ({len(values)} frames)"),
    )
    page.section("Your own", own.how, tables=[Table(("what", "measured"), rows, (1,))])


def extremes_bias(n: int, sigma: float, rng: np.random.Generator, draws: int = N_DRAWS) -> tuple[float, float]:
    """Bias and standard deviation (m) of highest minus lowest with ``n`` points at either end of ``sigma`` m each."""
    top, bottom = (rng.normal(0.0, sigma, (draws, n)) for _ in range(2))
    error = top.max(axis=1) - bottom.min(axis=1)
    return float(error.mean()), float(error.std())


def _noise(page: StudyPage) -> None:
    rng = np.random.default_rng(SEED)
    extremes = np.array([extremes_bias(n, POINT_SD, rng) for n in COUNTS])
    means = POINT_SD * np.sqrt(2.0 / np.array(COUNTS))
    fig, ax = figure(6.0, 3.0)
    ax.errorbar(COUNTS, extremes[:, 0] * MM, extremes[:, 1] * MM, fmt="o-", capsize=3, label="highest minus lowest")
    ax.errorbar(
        COUNTS,
        0.0 * means,
        means * MM,
        fmt="s-",
        capsize=3,
        color=COLOURS[2],
        label="mean of the top minus mean of the bottom",
    )
    ax.axhline(0.0, color="k", lw=0.8)
    ax.set(xscale="log", xlabel="points at the top, and at the bottom", ylabel="error of the height (mm)")
    ax.set_xticks(COUNTS, [str(n) for n in COUNTS])
    ax.minorticks_off()
    ax.legend()
    page.numbers["bias_m"] = dict(zip(map(str, COUNTS), extremes[:, 0], strict=True))
    bias, sigma = extremes_bias(1, POINT_SD, rng)
    _claims_of_points(page, bias, sigma, extremes[3, 0], means[3])
    page.section(
        "Noise makes bodies taller",
        f"Lengths between two points err by {LENGTH_SD * MM:g} mm (thesis 3.1), so each point by "
        f"{POINT_SD * MM:.2f} mm along the height. Points and bars: mean and standard deviation over {N_DRAWS} draws.",
        figures=[("height_noise", fig, "Error of the height by how it is read.")],
    )


def _claims_of_points(page: StudyPage, bias: float, sigma: float, extreme: float, mean: float) -> None:
    """Judge both of the thesis's ways to read a height, each for what it was used for.

    ``bias`` and ``sigma`` m of two points; ``extreme``, the bias of highest minus lowest, and ``mean``, the sigma of a
    difference of means, m with ``COUNTS[3]`` points at either end.
    """
    page.claim(
        "A top and a bottom point that are picked give the phantom's height (2.2)",
        f"± {LENGTH_SD * MM:.1f} mm",
        f"{bias * MM:+.1f} ± {sigma * MM:.1f} mm; means of {COUNTS[3]} points at either end: ± {mean * MM:.1f} mm",
        HOLDS if abs(bias) < 0.1 * sigma else FAILS,
        "1.1 mm is how much lengths scatter (3.1), with the errors of both points in it; no bias, if the points are "
        "the same ones each time.",
    )
    page.claim(
        "Highest minus lowest particle is the height of the SOFA model (2.3)",
        "used on the model alone",
        f"right without noise; of measured points + {extreme * MM:.1f} mm too tall with {COUNTS[3]} at either end",
        HOLDS,
        "The thesis does not read measured points so. Extremes of noisy points are biased, means of marked ones are "
        "not.",
    )


def _exports(page: StudyPage, data: Path | None) -> None:
    """SOFA's files: the user's, or the model's own positions written in SOFA's two formats and read back."""
    files = sofa_files(data)
    own = not files
    if own:
        deformed = cuboid(HEIGHT, YOUNG, "bonded", n=3)
        states = np.stack([deformed.space.nodes, deformed.x])
        files = [
            write_monitor(page.out / "cuboid_monitor_x.txt", states),
            write_state(page.out / "cuboid_state_x.txt", states),
        ]
    rows, numbers = [], {}
    for file in files:
        positions = read_sofa_positions(file)
        heights = positions.heights()
        numbers[file.name] = {"first": heights[0], "last": heights[-1], "n_particles": positions.points.shape[1]}
        rows.append(
            (
                file.name,
                str(len(heights)),
                str(positions.points.shape[1]),
                f"{heights[0] * MM:.3f}",
                f"{heights[-1] * MM:.3f}",
            )
        )
    slices = slice_heights(read_sofa_positions(files[0]))
    page.numbers |= {"sofa": numbers, "slices": slices}
    difference = 0.0
    if own:
        difference = max(abs(numbers[f.name]["last"] - float(np.ptp(states[1][:, 2]))) for f in files)
        page.claim(
            "SOFA's exports give the model's height (algorithm 1)",
            "Matlab import, split at spaces",
            f"both formats are read; the difference to the model is {difference * 1e6:.1f} µm",
            HOLDS,
            "The rounding of the file's decimals.",
        )
    _exports_section(page, rows, slices, own)


def _exports_section(
    page: StudyPage, rows: Sequence[tuple[str, ...]], slices: Sequence[tuple[str, ...]], own: bool
) -> None:
    """Show the heights of the files, and the slices of the first one."""
    page.section(
        "SOFA's exports",
        f"Files that SOFA's Monitor (tabs and spaces) and WriteState (T= and X= lines) write. {SCENE} "
        + ("No file was given with --data: the model's positions were written in both formats." if own else ""),
        tables=[
            Table(
                ("file", "steps", "particles", "first height (mm)", "last height (mm)"),
                tuple(rows),
                numbers=(1, 2, 3, 4),
            ),
            Table(
                ("slice from below", "height of its particles (mm)", "half width (mm)"),
                tuple(slices),
                numbers=(1, 2),
            ),
        ],
    )


# the public data sets: a folder of them is for the other studies, and holds none of SOFA's files
PUBLIC = ("stereo_checkerboard", "silicone_beam", "dot_cylinder", "compression")


def sofa_files(data: Path | None) -> list[Path]:
    """The user's SOFA files: the path itself, or every ``*_x.txt`` in it."""
    if data is None:
        return []
    if data.is_file():
        return [data]
    files = sorted(data.glob("*_x.txt"))
    if not files and not any((data / known).is_dir() for known in PUBLIC):
        raise InputError(
            "holds no SOFA file",
            where=str(data),
            remedy="name a file, or a folder of files whose names end in _x.txt; or leave --data away",
        )
    return files


def slice_heights(positions: SofaPositions) -> list[tuple[str, str, str]]:
    """Mean height, and half of the extent along x, of the particles in equal slices of the first state, in the last
    one."""
    first, last = positions.points[0], positions.points[-1]
    edges = np.linspace(first[:, 2].min(), first[:, 2].max(), SLICES + 1)
    which = np.clip(np.digitize(first[:, 2], edges) - 1, 0, SLICES - 1)
    rows = []
    for k in range(SLICES):
        part = last[which == k]
        if len(part):
            rows.append((f"{k + 1}", f"{part[:, 2].mean() * MM:.2f}", f"{0.5 * np.ptp(part[:, 0]) * MM:.2f}"))
    return rows


def write_monitor(path: Path, states: Array) -> Path:
    """``states`` (f, n, 3) as SOFA's Monitor writes them: time, then one tab-separated column per particle."""
    lines = ["# time\t" + "\t".join(f"particle_{i}" for i in range(states.shape[1]))]
    for k, state in enumerate(states):
        lines.append(f"{k}\t" + "\t".join(" ".join(f"{v:.9f}" for v in point) for point in state))
    path.write_text("\n".join(lines) + "\n")
    return path


def write_state(path: Path, states: Array) -> Path:
    """``states`` (f, n, 3) as SOFA's WriteState writes them."""
    lines = []
    for k, state in enumerate(states):
        lines += [f"T= {k}", "  X= " + " ".join(f"{v:.9f}" for v in state.ravel())]
    path.write_text("\n".join(lines) + "\n")
    return path
