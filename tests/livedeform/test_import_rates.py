"""When frames were measured is what a file says, or --rate: never a guess, and never two of them."""

from __future__ import annotations

from pathlib import Path

import ezc3d
import numpy as np
import pytest

from livedeform.cli import run as command_line
from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.bags.types import decode
from livedeform.common.errors import InputError
from livedeform.importing.points import Understanding, read_take

N = 200
PLACES = np.array([[0, 0, 50], [30, 0, 52], [0, 40, 51.0]])  # mm
COUNT = np.arange(N)


def table(folder: Path, times: list[str], name: str = "time", kept: np.ndarray = COUNT) -> Path:
    """Three markers in mm, with a column of times."""
    points = PLACES + np.random.default_rng(0).normal(0, 0.02, (N, 3, 3))
    rows = [",".join([times[k], *(f"{v:.4f}" for v in points[k].ravel())]) for k in kept]
    path = folder / "a.csv"
    path.write_text("\n".join([name + "".join(f",{n}_{a} [mm]" for n in "ABC" for a in "xyz"), *rows]) + "\n")
    return path


def every(step: int, first: int = 0) -> list[str]:
    return [str(first + step * int(k)) for k in COUNT]


@pytest.mark.parametrize(
    ("times", "rate", "said"),
    [
        (every(10), 0.0, r"taken as seconds, make 0.1 Hz and end at 1990 s; write their unit .*, as time \[ms\]"),
        (every(10), 100.0, r"its own times make 0.1 Hz, --rate says 100; write their unit .*, as time \[ms\]"),
        (every(1), 1000.0, r"its own times make 1 Hz, --rate says 1000; write their unit .*, as time \[ms\]"),
        (every(10_000), 0.0, r"make 0.0001 Hz .* as time \[us\]"),
        (every(10, 1_700_000_000_000), 0.0, r"make 0.1 Hz and end at 1.7e\+12 s; .* as time \[ms\]"),
        (every(1, 1_700_000_000_000), 0.0, r"make 1 Hz and end at 1.7e\+12 s; .* as time \[ms\]"),
        (every(10_000_000, 1_700_000_000_000_000_000), 0.0, r"make 1e-07 Hz and .* as time \[ns\]"),
        ([f"{k / 50:.3f}" for k in COUNT], 60.0, "its own times make 50 Hz, --rate says 60; leave out --rate"),
        ([f"{k / 1e5:.6f}" for k in COUNT], 0.0, r"make 1e\+05 Hz .* confirm with --rate HZ"),
    ],
)
def test_a_rate_that_nothing_confirms_is_refused(times: list[str], rate: float, said: str, tmp_path: Path):
    with pytest.raises(InputError, match=said):
        read_take([table(tmp_path, times)], Understanding(rate_hz=rate))


@pytest.mark.parametrize(
    ("times", "name", "said_hz", "rate"),
    [
        (every(10), "time_ms", 0.0, 100.0),
        (every(10), "time [ms]", 100.0, 100.0),
        (every(10, 1_700_000_000_000), "timestamp_ms", 0.0, 100.0),
        (every(10), "time [s]", 0.0, 0.1),  # a slow creep, with its unit
        (every(10), "time", 0.1, 0.1),  # or with --rate
        ([f"{k / 1e5:.6f}" for k in COUNT], "time", 1e5, 1e5),
        ([f"{k / 50:.3f}" for k in COUNT], "time", 49.0, 50.0),  # about so: the file's own times hold
        ([f"{k / 50:.3f}" for k in COUNT], "elapsed_time", 0.0, 50.0),
    ],
)
def test_a_rate_that_is_confirmed_is_taken(times: list[str], name: str, said_hz: float, rate: float, tmp_path: Path):
    take, _ = read_take([table(tmp_path, times, name)], Understanding(rate_hz=said_hz))
    assert take.rate_hz == pytest.approx(rate, rel=1e-3)
    np.testing.assert_allclose(take.seconds, COUNT / rate, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("rate", [0.0, 100.0])
def test_rows_that_are_missing_do_not_close_up(rate: float, tmp_path: Path):
    """In a column that is known to be the time; a column that may be one is refused."""
    kept = np.r_[0:50, 150:N]
    times = [f"{k / 100:.3f}" for k in COUNT]
    take, _ = read_take([table(tmp_path, times, "elapsed_time", kept)], Understanding(rate_hz=rate))
    np.testing.assert_allclose(take.seconds, kept / 100)
    with pytest.raises(InputError, match=r"has a column 'camera clock' that rises as a time does.*call it time \[s\]"):
        read_take([table(tmp_path, times, "camera clock", kept)], Understanding(rate_hz=rate))
    constant = table(tmp_path, ["0.004"] * N, "exposure time", kept)
    assert read_take([constant], Understanding(rate_hz=100.0))[0].seconds[-1] == pytest.approx(0.99)


def moments(folder: Path, names: list[str]) -> list[Path]:
    out = []
    for k, name in enumerate(names):
        out.append(folder / f"{name}.csv")
        out[-1].write_text("x,y,z\n" + "".join(f"{x},{y},{z - k}\n" for x, y, z in PLACES))
    return out


@pytest.mark.parametrize(
    ("names", "seconds", "missing"),
    [
        ([f"step_{k}" for k in (1, 2, 3, 7, 8)], [0, 1, 2, 6, 7], 3),
        ([f"cam0_{k:04d}_left2" for k in (10, 20, 40, 50)], [0, 1, 3, 4], 1),  # every tenth picture, at --rate
        ([f"step_{k}" for k in (8, 9, 10, 11)], [0, 1, 2, 3], 0),
        (["start", "touch", "zenith"], [0, 1, 2], 0),  # no numbers: by their order
        (["a1_1", "a1_2", "a2_1"], [0, 1, 2], 0),  # two numbers
    ],
)
def test_a_moment_that_is_missing_leaves_its_time(names: list[str], seconds: list[int], missing: int, tmp_path: Path):
    files = moments(tmp_path, names)
    take, said = read_take(files, Understanding("mm", 2.0, dic=True))
    np.testing.assert_allclose(take.seconds, np.array(seconds) / 2)
    assert (f"({missing} missing by the files' numbers)" in said) == bool(missing)
    words = ["import", "surface", *map(str, files), "--rate", "2", "--units", "mm", "--out", str(tmp_path / "bags")]
    assert command_line(words) == 0
    with read_bag(next((tmp_path / "bags").glob("*.mcap"))) as bag:
        stamps = [decode(raw).header.stamp for raw in bag.messages([t.STEREO_SURFACE])]
    found = [s.sec - stamps[0].sec + 1e-9 * (s.nanosec - stamps[0].nanosec) for s in stamps]
    np.testing.assert_allclose(found, np.array(seconds) / 2)


def test_numbers_that_count_no_moments_are_refused(tmp_path: Path):
    files = moments(tmp_path, [f"img_{k}" for k in (1000, 1010, 1021, 1033, 1041)])
    with pytest.raises(InputError, match="rise by 8 to 12 and do not tell which moments are missing; number the files"):
        read_take(files, Understanding("mm", 100.0, dic=True))


def test_a_trc_file_has_the_rate_of_its_times(tmp_path: Path):
    head = ["PathFileType\t4\t(X/Y/Z)\ta.trc", "DataRate\tNumMarkers\tUnits", "0.1\t1\tmm", "Frame#\tTime\tA\t\t",
            "\t\tX1\tY1\tZ1"]  # fmt: skip
    rows = [f"{k}\t{10 * k}\t0.1\t0.2\t{k + 1}" for k in range(20)]
    path = tmp_path / "a.trc"
    path.write_text("\n".join([*head, *rows]) + "\n")
    assert read_take([path], Understanding())[0].rate_hz == pytest.approx(0.1)
    with pytest.raises(InputError, match=r"make 0.1 Hz, --rate says 100"):
        read_take([path], Understanding(rate_hz=100.0))
    path.write_text("\n".join([*head, *rows]).replace("0.1\t1\tmm", "100\t1\tmm") + "\n")
    with pytest.raises(InputError, match=r"make 0.1 Hz and end at 190 s"):
        read_take([path], Understanding())


def test_a_c3d_file_has_its_own_rate(tmp_path: Path):
    file = ezc3d.c3d()
    for key, value in (("RATE", [0.1]), ("UNITS", ["mm"]), ("LABELS", ["A"])):  # slow, and stated
        file["parameters"]["POINT"][key]["value"] = value
    file["data"]["points"] = np.ones((4, 1, 20))
    file.write(str(tmp_path / "a.c3d"))
    for said_hz in (0.0, 0.1):
        assert read_take([tmp_path / "a.c3d"], Understanding(rate_hz=said_hz))[0].rate_hz == pytest.approx(0.1)
    with pytest.raises(InputError, match=r"make 0.1 Hz, --rate says 100; leave out --rate"):
        read_take([tmp_path / "a.c3d"], Understanding(rate_hz=100.0))


def test_what_is_refused_is_one_line_and_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = table(tmp_path, every(10))
    words = ["import", "points", str(path), "--out", str(tmp_path / "bags")]
    for more in ([], ["--rate", "100"]):
        assert command_line([*words, *more]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and "a.csv" in error and not (tmp_path / "bags").exists()
    table(tmp_path, every(10), "time_ms")
    assert command_line([*words, "--rate", "100"]) == 0
    frames = load_recording(tmp_path / "bags" / "a.mcap").marker_frames
    assert len(frames) == N and frames[-1].stamp_ns - frames[0].stamp_ns == 1_990_000_000
