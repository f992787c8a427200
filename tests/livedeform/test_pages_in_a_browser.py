"""Reports in a real browser, at the widths of a phone, a tablet and a screen, light and dark: nothing overflows, every
chart is drawn, the slider moves, figures can be saved. Skipped where there is no browser to ask."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from livedeform.compare_node.metrics import run_metrics
from livedeform.compare_node.residual import Residual
from livedeform.comparing.page import write_comparison
from livedeform.comparing.runs import ComparedRun, compared

CHROMIUM = next((p for name in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(name))), "")
playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CHROMIUM, reason="no Chromium on this machine"),
]
WIDTHS = (390, 768, 1400)  # a phone, a tablet, a screen
LARGEST = 3_000_000  # bytes of a page
LOOKS = Path(__file__).parent / "looks.npz"  # how the pages looked: small grey pictures; LOOKS_AGAIN=1 takes new ones
LOOK = (24, 36)  # px across, down
UNLIKE = 12.0
"""Of 255 grey levels, mean. Measured over widths and schemes: the same browser 0, letters with serifs 1.5 to 9.8, a
page without its first figure 7.7 to 15.6, the other colours 204: small changes are not seen."""
OVERFLOWING = """() => [...document.querySelectorAll('body *')].filter(e => {
    const box = e.getBoundingClientRect();
    return box.width > 0 && box.right > innerWidth + 1 && !e.closest('.scroll, pre, svg, .chart');
}).map(e => e.tagName + '.' + e.className).slice(0, 5)"""
CLIPPED_TABLES = """() => [...document.querySelectorAll('table')].filter(e => !e.closest('.scroll')).length"""
DRAWN = "() => [...document.querySelectorAll('.chart')].map(e => e._fullData ? e._fullData.length : 0)"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    options = ["--no-sandbox", "--use-gl=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    with playwright.sync_playwright() as play:
        opened = play.chromium.launch(executable_path=CHROMIUM, args=options)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A run's report with playback, and a comparison."""
    folder = tmp_path_factory.mktemp("pages")
    runs = [made(name, 1e-3 * scale) for name, scale in (("declared", 1.0), ("fitted", 0.4))]
    write_comparison(folder, runs, [compared(runs[0], runs[1])])
    return {"compare": folder / "compare.html", "run": short_run(folder / "run")}


def made(name: str, sigma: float) -> ComparedRun:
    errors = np.random.default_rng(len(name)).normal(0.0, sigma, (60, 30, 3))
    ids, nothing = np.arange(1, 31, dtype=np.uint32), np.full((30, 3, 3), np.nan)
    residuals = tuple(Residual(10**9 + k * 10**8, ids, e, np.zeros_like(e), nothing) for k, e in enumerate(errors))
    return ComparedRun(name, Path(name), "OK", "tuesday.mcap", residuals, run_metrics(residuals, 0.001), 10**9)


def short_run(out: Path) -> Path:
    """The first seconds of the shipped block's second recording, until it is pressed, through the three nodes."""
    from livedeform.run.running import RunOptions, run
    from livedeform.shipped import CUBOID, shipped

    folder = shipped(CUBOID)
    run(RunOptions(folder / "experiment", folder / "bags" / "b", out, duration=2.0, at_frames=True), lambda *_: None)
    return out / "report.html"


def opened(browser: Any, page: Path, width: int, scheme: str) -> Any:
    tab = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
    tab.complaints = []
    tab.on("pageerror", lambda error: tab.complaints.append(str(error)))
    tab.goto(page.as_uri())
    until = time.monotonic() + 120.0
    while not (drawn := tab.evaluate(DRAWN)) or not all(drawn):  # the page's policy forbids wait_for_function's eval
        assert time.monotonic() < until, f"not drawn: {drawn}, {tab.complaints}"
        tab.wait_for_timeout(100)
    return tab


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", ["compare", "run"])
def test_nothing_overflows(browser: Any, pages: dict[str, Path], name: str, width: int, scheme: str, tmp_path: Path):
    tab = opened(browser, pages[name], width, scheme)
    try:
        assert tab.evaluate("document.documentElement.scrollWidth") <= width
        assert tab.evaluate(OVERFLOWING) == []
        assert tab.evaluate(CLIPPED_TABLES) == 0
        assert tab.complaints == []
        shot = tmp_path / f"{name}-{width}-{scheme}.png"
        tab.screenshot(path=str(shot), full_page=True)
        looks_as_before(shot)
    finally:
        tab.close()


def look(shot: Path) -> np.ndarray:
    """The picture of a page in so few grey pixels that letters do not matter, and the lie of its parts does."""
    return np.asarray(Image.open(shot).convert("L").resize(LOOK, Image.Resampling.BOX), np.uint8)


def looks_as_before(shot: Path) -> None:
    """Compare with the kept picture of the same name; take it anew where LOOKS_AGAIN is set."""
    kept = dict(np.load(LOOKS)) if LOOKS.exists() else {}
    if os.environ.get("LOOKS_AGAIN"):
        np.savez_compressed(LOOKS, **(kept | {shot.stem: look(shot)}))
        return
    difference = np.abs(look(shot).astype(float) - kept[shot.stem]).mean()
    assert difference < UNLIKE, (
        f"{shot} looks other than it did: {difference:.0f} grey levels; LOOKS_AGAIN=1 if it should"
    )


def test_another_look_is_seen(browser: Any, pages: dict[str, Path], tmp_path: Path):
    """A page without its first figure, and one in the other colours, are not taken for the kept one."""
    kept = dict(np.load(LOOKS))["run-768-light"].astype(float)
    for name, change, scheme in (
        ("missing", "() => document.querySelector('.chart').closest('section').remove()", "light"),
        ("other-colours", "() => 0", "dark"),
    ):
        tab = opened(browser, pages["run"], 768, scheme)
        try:
            tab.evaluate(change)
            tab.screenshot(path=str(tmp_path / f"{name}.png"), full_page=True)
        finally:
            tab.close()
        assert np.abs(look(tmp_path / f"{name}.png") - kept).mean() > UNLIKE


def test_figures_keep_their_height_when_the_window_changes(browser: Any, pages: dict[str, Path]):
    """A phone that is turned: the error over time was flattened to the element's least height."""
    tab = opened(browser, pages["run"], 390, "light")
    heights = "() => [...document.querySelectorAll('.chart')].map(e => e.clientHeight)"
    try:
        before = tab.evaluate(heights)
        tab.set_viewport_size({"width": 900, "height": 400})
        tab.wait_for_timeout(1000)
        assert tab.evaluate(heights) == before and min(before) >= 300
    finally:
        tab.close()


def test_the_slider_moves_the_surface(browser: Any, pages: dict[str, Path]):
    tab = opened(browser, pages["run"], 1400, "light")
    try:
        first = tab.evaluate("Array.from(document.getElementById('playback')._fullData[0].z)")
        last = "document.getElementById('playback')._transitionData._frames.length - 1"
        assert tab.evaluate(last) >= 5
        tab.evaluate(
            f"""() => {{ const e = document.getElementById('playback');
            return Plotly.animate(e, [e._transitionData._frames[{last}].name],
                                  {{mode: 'immediate', frame: {{duration: 0, redraw: true}}}}); }}"""
        )
        now = tab.evaluate("Array.from(document.getElementById('playback')._fullData[0].z)")
        assert np.abs(np.array(now) - np.array(first)).max() > 0.1  # mm: it is pressed
    finally:
        tab.close()


def test_a_figure_is_saved_as_a_table(browser: Any, pages: dict[str, Path], tmp_path: Path):
    tab = opened(browser, pages["run"], 1400, "light")
    try:
        with tab.expect_download() as saved:
            tab.click(".saves[data-chart='over-time'] button[data-format='csv']")
        saved.value.save_as(tmp_path / "over-time.csv")
        rows = (tmp_path / "over-time.csv").read_text().splitlines()
        assert rows[0] == "trace,x,y,z" and any(row.startswith("rmse,") for row in rows)
    finally:
        tab.close()


def test_a_page_is_small(pages: dict[str, Path]):
    for name, page in pages.items():
        assert page.stat().st_size < LARGEST, f"{name}: {page.stat().st_size / 1e6:.1f} MB"
