"""The text of a new ``experiment.yaml``, with a comment at every key."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from livedeform.new.questions import Answers

COLUMN = 44
HEAD = """\
# yaml-language-server: $schema=experiment.schema.json
# Lengths are in metres, moduli in pascals. An editor with YAML support explains every key (the line above).
# Check it with:  livedeform info .
version: 1
"""

PHANTOM = """\
name: {name}
phantom:
  surface: {surface}
  unit: {unit}  # of that file only
  configuration: {configuration}  # loaded: scanned while its weight acted; unloaded: the shape without weight
  element_size: {element_size}  # edge of the tetrahedra; half of it costs about ten times as long
  density: {density}  # kg/m3
  {density_sigma}  # a standard deviation beside any quantity is used as a prior by a diagnosis
  material:
    model: {material}
    youngs_modulus: {modulus}  # Pa
    {modulus_sigma}
    poisson_ratio: {poisson}  # nearly incompressible: 0.49
  gravity: {gravity}  # m/s2, during the recording
  # scan_gravity: {gravity}  # while the surface was scanned, where that was another direction
  support:  # where the body is held, as below_z, above_z, box, sphere or plane
    - {{region: {{below_z: {support_below}}}, type: {support}}}
  markers: markers.csv  # id,x,y,z,kind
  # lesions:  # places inside whose motion is to be predicted
  #   - {{name: t1, centre: [0.0, 0.0, 0.03], diameter: 0.01}}
"""

PROBE = """\
probe:  # its frame: origin in the middle of the contact face, +z out of it into the body
  shape: {shape}
  edge_radius: {edge_radius}
  contact: {{formulation: lagrange, friction: {friction}}}
"""

STEREO = """\
  pose: registered  # of the left camera: found from the markers at rest
  detector: {{type: blob}}  # blob | circle_grid | checkerboard | aruco | apriltag
"""

TAIL = """\
# loads:  # forces besides the weight, in all, spread over a region's surface
#   - {{name: weight, region: {{above_z: 0.05}}, force: [0.0, 0.0, -0.5]}}
# timeline: {{release: 0.0}}  # s after the recording's start from which gravity and loads act
effects: []  # what the model has beyond the above; a diagnosis adds to it
thresholds: {{error: {threshold}}}  # m; a run with a smaller error is OK
"""


def experiment_text(answers: Answers, surface: str, unit: str, cameras: Sequence[str] | None) -> str:
    """The file's text; ``surface`` and ``cameras`` are names of files beside it (no cameras: None, recorded: ())."""
    sigma, spread = answers["modulus_sigma"], answers["density_sigma"]
    said = {
        **{key: _number(value) for key, value in answers.values.items()},
        "name": _quoted(answers["name"]),
        "surface": _quoted(surface),
        "unit": unit,
        "gravity": "[" + ", ".join(_number(x) for x in answers["gravity"]) + "]",
        "density_sigma": f"density_sigma: {_number(spread)}" if spread else "# density_sigma: 5.0",
        "modulus_sigma": f"youngs_modulus_sigma: {_number(sigma)}" if sigma else "# youngs_modulus_sigma: 500.0",
    }
    parts = [HEAD, _filled(PHANTOM, said)]
    if answers["probe"] is not None:
        (shape,) = answers["probe"].items()
        parts.append(_filled(PROBE, said | {"shape": f"{{{shape[0]}: {_size(shape[1])}}}"}))
    if cameras is not None:
        sides = zip(("left", "right"), cameras, strict=False)
        files = "".join(f"  {side}: {_quoted(name)}\n" for side, name in sides)
        parts += ["stereo:\n", files or "  # left, right: the recording's CameraInfo is used\n", _filled(STEREO, said)]
    return "".join([*parts, _filled(TAIL, said)])


def _filled(template: str, said: Mapping[str, str]) -> str:
    """Fill in a part, the comments of its keys at ``COLUMN``: what is filled in may hold whatever marks a comment."""
    lines = []
    for line in template.splitlines():
        code, sign, comment = line.partition(" # ")
        filled = code.format(**said).rstrip()
        if not sign or not filled.strip() or filled.lstrip().startswith("#"):
            lines.append(line.format(**said))
        else:
            lines.append(f"{filled:{COLUMN}} # {comment.format(**said).strip()}")
    return "".join(f"{line}\n" for line in lines)


def _quoted(text: str) -> str:
    """A text in quotes, as YAML reads it back whatever it holds."""
    return str(yaml.safe_dump(text, default_style='"', allow_unicode=True, width=float("inf"))).strip()


def _size(value: Any) -> str:
    """Write what follows a probe's shape: a number, several, or a file's name."""
    return _quoted(value) if isinstance(value, str) else json.dumps(value)


def _number(value: Any) -> str:
    """A number as YAML reads it back; text as it is."""
    return repr(float(value)) if isinstance(value, int | float) else str(value)
