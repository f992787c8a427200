"""Writes docs/effects.md from the effects' own cards: what the catalogue says and what the docs say cannot differ.

python docs/make_effects.py            writes the page
python docs/make_effects.py --check    exit code 1 if the page is not what the catalogue says
"""

from __future__ import annotations

import sys
from pathlib import Path

from livedeform.closed_loop.candidates import all_effects
from livedeform.common.effect import EffectInfo, Parameter

PAGE = Path(__file__).parent / "effects.md"
PLACES = {
    "body": "the body (fem_node)",
    "support": "the support (fem_node)",
    "load": "the loads (fem_node)",
    "probe": "the probe (fem_node)",
    "measuring": "the measurement (stereo_node)",
}
HEAD = """# Effects

Every effect that `livedeform diagnose` can find, add and run. This page is written by `python docs/make_effects.py`
from the effects' own cards; do not edit it. Conventions on signs and clocks stand at the end.

"""
TAIL = """
## Conventions

- `viscoelasticity`: isochoric Prony series, g relative to the instantaneous modulus; the declared modulus is the
  relaxed one. `held`: the body hung under its loads for long, and was then held as it was scanned for so many seconds
  until the recording began (without it: for long), in all recordings alike. It is meant for bodies that
  only relax, and acts where one is let go and no probe is there.
- `softening`: E(t) = E exp(-rate t). `swelling`: J = 1 + offset + rate t, stress-free and isotropic. t counts from the
  first stamp of the earliest recording, and drifts go on into later ones.
- `stiffness_gradient`: E(z) = E (1 + slope (z - H/2)), H the unloaded height. Every `ratio` is true over declared.
- `gravity_tilt`: gravity turned by the rotation vector (angle_x, angle_y, 0), and with it each load within 11 degrees
  of the declared gravity, which is taken for a weight that hangs on the body.
- `scan_gravity`: the fraction of `scan_gravity` that the scanned shape carried.
- `late_load`: all loads, and the mass that hangs with those along gravity, act `delay` s after the release.
- `load_friction`: each load rubs by `ratio` times its size, against its place's motion, and gives by some `give` first.
- `stereo_scale`: measured = scale x true, about the left camera, then registered rigidly at rest.
- `camera_motion`: both cameras move as one rigid body by this, in the left optical frame, once, at `onset`.
- `probe_offset`: true pose = recorded pose displaced by the translation in the probe frame.
- `time_offset` > 0: the probe's stamps are late.

## Adding an effect

One new file in `src/livedeform/fem_node/effects` (or `src/livedeform/stereo_node/effects` if it acts on the
measurement) with its card `INFO`, an `EffectInfo`, and `apply(physics, values)` (or `distort` and `correct`), one row
in `PUBLISHED` of `src/livedeform/common/published_effects.py` (its parameters' sizes and possible values), and a test
that fails without it. The folder is the registry. Neither the solver nor the search has an `if` for any effect: an
effect changes the `Physics` record that the solver is built from, and what the search must know of it (scale, step,
starts, whether its derivative at zero is to be trusted) stands on its card.
"""


def size(parameter: Parameter) -> str:
    """How a parameter's name is written with its length."""
    if parameter.size is None:
        return parameter.name
    return f"{parameter.name}[]" if parameter.size < 0 else f"{parameter.name}[{parameter.size}]"


def section(info: EffectInfo) -> str:
    """One effect."""
    rows = [
        f"## {info.name}",
        "",
        f"{sentence(info.summary)} Acts on {PLACES[info.acts_on]}.",
        "",
        f"    {info.equation}",
        "",
    ]
    rows += ["| parameter | unit | start | bounds |", "|---|---|---|---|"]
    for p in (*info.parameters, *info.optional):
        start = p.start if isinstance(p.start, float | int) else ", ".join(f"{v:g}" for v in p.start)
        start = f"{start:g}" if isinstance(start, float | int) else start
        name = f"`{size(p)}`" + (" (need not be given)" if p in info.optional else "")
        rows.append(f"| {name} | {p.unit} | {start} | {p.lower:g} to {p.upper:g} |")
    rows += ["", f"Source: {info.source}."]
    if info.shown_by:
        rows.append(f"Shown by: {info.shown_by}.")
    if info.confused_with:
        rows.append("Easily taken for: " + ", ".join(f"`{name}`" for name in info.confused_with) + ".")
    return "\n".join(rows) + "\n"


def sentence(text: str) -> str:
    """With a capital and a full stop."""
    return text[:1].upper() + text[1:].rstrip(".") + "."


def page() -> str:
    """The whole page."""
    effects = sorted(all_effects().values(), key=lambda info: info.name)
    table = ["| effect | acts on | what the declared model lacks |", "|---|---|---|"]
    table += [f"| [`{e.name}`](#{e.name}) | {e.acts_on} | {e.summary} |" for e in effects]
    return HEAD + "\n".join(table) + "\n\n" + "\n".join(section(e) for e in effects) + TAIL


if __name__ == "__main__":
    if "--check" in sys.argv:
        sys.exit(0 if PAGE.exists() and PAGE.read_text() == page() else 1)
    PAGE.write_text(page())
