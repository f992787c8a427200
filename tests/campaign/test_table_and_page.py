"""The table is the same for the same rows, and the page opens offline; with 10 000 rows in a browser (slow)."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pyarrow")

import pyarrow.parquet as pq
from benchmarks.campaign import synthetic_rows

from livedeform.campaign.page import write_campaign_page
from livedeform.campaign.row import Row, effect_words, failed_row, row_of
from livedeform.campaign.table import CSV, PARQUET, read_table, write_table

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), ""
)
METRICS = {
    "verdict": "OK",
    "error": {"rmse": 1e-3},
    "noise_floor": 1e-4,
    "coverage": {"frames_compared": 9, "frames_measured": 10},
    "mesh": {"digest": "abc"},
}
EFFECT = {"name": "viscoelasticity", "parameters": {"g": {"value": [0.3], "sigma": [0.01]}, "tau": {"value": [2.0]}}}
DIAGNOSIS = {
    "verdict": "effect",
    "effects": [EFFECT],
    "candidates": [{"name": "viscoelasticity", "indistinguishable_from": ["softening", "viscoelasticity"]}],
    "error_before": {"rmse": 1e-3},
    "error_after": {"rmse": 2e-4},
    "improvement_interval": [0.7, 0.9],
    "unexplained": "nothing",
}


def test_a_row_says_what_was_measured_and_found() -> None:
    row = row_of(METRICS, DIAGNOSIS, (5, 2_000_000_005))
    assert (row["coverage"], row["duration_s"], row["error_after_m"]) == (0.9, 2.0, 2e-4)
    assert row["effects"] == "viscoelasticity: g 0.3 [0.28, 0.32], tau 2 s"
    assert row["rivals"] == "softening"
    assert effect_words({"name": "density", "parameters": {"ratio": {"value": 1.1}}}) == "density: ratio 1.1"


@pytest.mark.parametrize(
    ("parameter", "said"),
    [
        ({"value": 8.0, "sigma": 5.0, "interval": [2.3, 27.0]}, "8 [2.3, 27]"),
        ({"value": [0.3, 2.0], "sigma": [0.1, 1.0], "interval": [[0.2, 0.5], [1.0, 4.0]]}, "0.3 [0.2, 0.5] 2 [1, 4]"),
        ({"value": 1.28e5, "sigma": 9e4, "interval": [4.3e4, None]}, "1.28e+05 [4.3e+04, inf]"),
        ({"value": 2.0, "sigma": 0.5}, "2 [1.02, 2.98]"),  # of an earlier version
    ],
)
def test_an_interval_is_the_one_that_the_diagnosis_states(parameter: dict[str, Any], said: str) -> None:
    """In the parameter's own coordinate, wherefore it is not even; by sigmas a contrast of 8 was "8 [-1.8, 17.8]"."""
    assert effect_words({"name": "inclusion", "parameters": {"ratio": parameter}}) == f"inclusion: ratio {said}"


def test_equal_rows_make_equal_files_and_nothing_half_written_stays(tmp_path: Path) -> None:
    rows = list(synthetic_rows(30))
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        assert write_table(iter(rows), tmp_path / name) == 30
    for file in (PARQUET, CSV):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    assert list(read_table(tmp_path / "a")) == rows

    def breaks() -> Iterator[Row]:
        yield rows[0]
        raise OSError(28, "No space left on device")

    before = (tmp_path / "a" / CSV).read_bytes()
    with pytest.raises(OSError):
        write_table(breaks(), tmp_path / "a")
    assert (tmp_path / "a" / CSV).read_bytes() == before
    assert {p.name for p in (tmp_path / "a").iterdir()} == {PARQUET, CSV}


def test_a_failed_recording_has_its_line(tmp_path: Path) -> None:
    labels = {"recording": "p/take", "phantom": "p", "rig": "rig", "key": ""}
    write_table(iter([labels | failed_row("take.mcap: the bag is broken")]), tmp_path)
    table = pq.read_table(tmp_path / PARQUET).to_pylist()
    assert (table[0]["status"], table[0]["problem"]) == ("failed", "take.mcap: the bag is broken")


def test_the_page_fetches_nothing_and_no_text_ends_its_script(tmp_path: Path) -> None:
    rows = [*synthetic_rows(3)]
    rows[0]["recording"] = "</script><script>alert(1)</script>"
    shared = {"effect": "stereo_scale", "scope": "rig a", "n_members": 14, "n_recordings": 20}
    page = write_campaign_page(rows, [shared | {"said": ["scale 1.01"], "scatter_said": []}], tmp_path, "<lab>")
    html = page.read_text()
    assert "14 of 20" in html and "&lt;lab&gt;" in html and "alert(1)</script>" not in html
    assert not re.search(r"(src|href)=[\"']?(https?:)?//", html)


def shown(rows: list[Row], out: Path) -> list[dict[str, Any]]:
    """The cells of the page's rows by name, as its script reads them."""
    html = write_campaign_page(rows, [], out, "lab").read_text()
    found = re.search(r'id="campaign-data">(.*?)</script>', html, re.S)
    assert found is not None and "<" not in found[1]
    data = json.loads(found[1], parse_constant=lambda constant: pytest.fail(f"{constant} is no JSON"))
    return [dict(zip((c["name"] for c in data["columns"]), row, strict=False)) for row in data["rows"]]


@pytest.mark.parametrize("name", ["<!--<script>", "</script>", "<b>&amp;", "Gel\u00e4 \u51dd\u80f6", "a\u2028b"])
def test_no_name_is_markup(tmp_path: Path, name: str) -> None:
    """After "<!--<script>" in a name the rest of the page was text of its script."""
    rows = [*synthetic_rows(2)]
    rows[0]["recording"] = rows[0]["effects"] = name
    assert [row["recording"] for row in shown(rows, tmp_path)] == [name, rows[1]["recording"]]


def test_the_page_shows_the_tables_numbers(tmp_path: Path) -> None:
    """Rounded once: 0.12349 mm was 0.124; and 999 of 1000 frames are not 100 %. What is no number stays empty."""
    rows = [*synthetic_rows(2)]
    rows[0] |= {"rmse_m": 0.12349e-3, "coverage": 0.9996, "noise_floor_m": -1e-12}
    rows[1] |= {"rmse_m": float("nan"), "coverage": 1.0, "noise_floor_m": float("inf")}
    first, second = shown(rows, tmp_path)
    assert f"{first['rmse_m']:.3f}" == "0.123" and first["coverage"] == 99.9 and str(first["noise_floor_m"]) == "0.0"
    assert second["rmse_m"] == second["noise_floor_m"] == "" and second["coverage"] == 100.0


SCRIPT = """
<script>
const result = {}, list = document.getElementById("rows"), wait = () => new Promise(done => setTimeout(done, 50));
const first = () => document.querySelector("#rows .line .cell").textContent;
const timed = async (name, act) => {
  const t = performance.now();
  act();
  result[name + "_ms"] = performance.now() - t;
  await wait();
};
(async () => {
  await wait();
  result.drawn = document.querySelectorAll("#rows .line").length;
  const button = name => document.querySelector(`#heads button[data-column=${name}]`);
  await timed("sort", () => button("rmse_m").click());
  const column = [...document.querySelectorAll("#heads button")].findIndex(b => b.dataset.column === "rmse_m");
  result.sorted = [...document.querySelectorAll("#rows .line")].map(l => l.children[column].textContent);
  await timed("sort_down", () => button("recording").click());
  await timed("reverse", () => button("recording").click());
  result.last = first();
  const search = document.getElementById("search");
  await timed("filter", () => { search.value = "phantom-0007 -take-03"; search.oninput(); });
  result.filtered = document.getElementById("shown").textContent;
  search.value = ""; search.oninput();
  await timed("scroll", () => { list.scrollTop = 5000 * 28; list.dispatchEvent(new Event("scroll")); });
  await wait();
  result.scrolled = first();
  result.timelines = document.querySelectorAll("#timelines canvas").length;
  const out = document.createElement("pre");
  [out.id, out.textContent] = ["result", JSON.stringify(result)];
  document.body.append(out);
})();
</script></body>"""


def in_a_browser(page: Path) -> dict[str, Any]:
    """Sort, filter and scroll the page in Chromium; what it shows, and how long each took."""
    copy = page.with_name("driven.html")
    copy.write_text(page.read_text().replace("</body>", SCRIPT))
    words = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=20000", "--dump-dom"]
    done = subprocess.run([*words, copy.as_uri()], capture_output=True, text=True, timeout=900, check=True)
    found = re.search(r'<pre id="result">(.*?)</pre>', done.stdout, re.S)
    assert found is not None, done.stderr[-2000:]
    return dict(json.loads(found[1]))


@pytest.mark.slow
@pytest.mark.skipif(not CHROMIUM, reason="there is no Chromium here")
def test_ten_thousand_rows_are_usable_in_a_browser(tmp_path: Path) -> None:
    page = write_campaign_page(synthetic_rows(10_000), [], tmp_path, "10 000 recordings")
    said = in_a_browser(page)
    assert said["drawn"] < 60  # of 10 000: the rest is not in the document
    numbers = [float(x) for x in said["sorted"] if x]
    assert numbers == sorted(numbers)
    assert said["last"] == "phantom-0499/take-19"
    assert said["filtered"] == "19 of 10000"
    assert said["scrolled"].startswith("phantom-02")
    assert 0 < said["timelines"] < 40
