"""A run in three dimensions with a time slider: one HTML file that opens offline."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import InputError
from livedeform.common.experiment.schema import Probe
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.outputs import write_text
from livedeform.report.page import POLICY
from livedeform.report.playback import figure, read_playback
from livedeform.report.run.read import residuals_of


def write_view(run: Path, out: Path, tell: Callable[..., None]) -> Path:
    """Writes the viewer of a run's folder, or of its recording, to ``out``."""
    bag_path = run / "run.mcap" if run.is_dir() and (run / "run.mcap").is_file() else run
    recording = load_recording(bag_path)
    residuals = [r for r in residuals_of(recording) if len(r.ids)]
    if not residuals:
        raise InputError("holds no errors of a model", where=str(run), remedy="make it with livedeform run")
    tell("reading the predicted surfaces")
    probe = probe_of(bag_path.parent / "experiment.yaml")
    playback = read_playback(bag_path, residuals, recording.poses, probe, recording.start_ns)
    tell(f"drawing {len(playback.moments)} moments")
    shown = figure(playback)
    title = f"{run.resolve().name}: predicted surface, probe, measured and predicted markers"
    shown.update_layout(title=title, height=None, margin={"t": 100})
    page = shown.to_html(include_plotlyjs=True, auto_play=False)
    write_text(out, page.replace("<head>", f"<head>{POLICY}", 1))
    return out


def probe_of(experiment: Path) -> Probe | None:
    """The probe of the experiment beside a recording; None where there is none."""
    return load_experiment(experiment, geometry=False).probe if experiment.is_file() else None
