"""Is what an experiment declares likely? Findings about values that can be, but are mostly another unit."""

from __future__ import annotations

import numpy as np

from livedeform.common.checks.finding import Finding
from livedeform.common.experiment.schema import USED_SIGMAS, Experiment
from livedeform.common.experiment.surface import Surface

COLLAPSE = 5.0  # weight of a column as high as the body over its modulus: all but flat layers are crushed by it
STEEP = 1.0  # rad, of a tilt
EARTH = (9.5, 10.1)  # m/s2
LARGE = 0.1  # of the diagonal
LET, METRES = "nearly nothing is wrong by that", "lengths are in metres: 2 mm is 0.002"


def check_declared(experiment: Experiment, body: Surface) -> list[Finding]:
    """Doubt a body that its own weight crushes, a tilt of gravity that is in degrees and a gravity in another unit by
    all likelihood, and errors that are large for this body; name the standard deviations that nothing uses."""
    return [
        *_weight(experiment, body),
        *_gravity(experiment),
        *_tilt(experiment),
        *_large_errors(experiment, body),
        *_unused(experiment),
    ]


def _weight(experiment: Experiment, body: Surface) -> list[Finding]:
    phantom = experiment.phantom
    acting = [phantom.gravity, *([phantom.scan_gravity] if phantom.configuration == "loaded" else [])]
    stress = phantom.density * max(float(np.ptp(body.vertices @ np.array(gravity))) for gravity in acting)  # Pa
    modulus = phantom.material.youngs_modulus
    if stress <= COLLAPSE * modulus:
        return []
    text = (
        f"under its own weight ({stress:.3g} Pa at its lowest point) a body with a modulus of {modulus:g} Pa collapses"
    )
    return [Finding("WARN", text, "give phantom.material.youngs_modulus in pascals: 4 kPa is 4000")]


def _gravity(experiment: Experiment) -> list[Finding]:
    size = float(np.linalg.norm(experiment.phantom.gravity))
    if size == 0.0 or EARTH[0] < size < EARTH[1]:
        return []
    text = f"phantom.gravity is {size:.3g} m/s2, neither the Earth's nor nothing"
    return [Finding("WARN", text, "give it in m/s2: [0, 0, -9.81]")]


def _large_errors(experiment: Experiment, body: Surface) -> list[Finding]:
    """Doubt a threshold and places of markers that allow for errors of a good part of the body."""
    sigmas = experiment.markers.sigmas[np.isfinite(experiment.markers.sigmas)]
    said = [("thresholds.error", experiment.thresholds.error), ("sigma in markers.csv", float(sigmas.max(initial=0.0)))]
    return [
        Finding(
            "WARN",
            f"{name} is {1e3 * error:.3g} mm, of a body of {1e3 * body.diagonal:.3g} mm: {LET}",
            METRES,
            doubts=True,
        )
        for name, error in said
        if error > LARGE * body.diagonal
    ]


def _tilt(experiment: Experiment) -> list[Finding]:
    found = []
    for effect in experiment.effects:
        if effect.name == "gravity_tilt":
            angle = float(np.hypot(effect.values["angle_x"], effect.values["angle_y"]))
            if angle > STEEP:
                text = f"the effect 'gravity_tilt' turns gravity by {angle:.3g} rad, {np.degrees(angle):.0f} degrees"
                found.append(Finding("WARN", text, "give its angles in radians: 2 degrees are 0.035"))
    return found


def _unused(experiment: Experiment) -> list[Finding]:
    unused = [key for key in experiment.sigmas if key not in USED_SIGMAS]
    if not unused:
        return []
    text = f"standard deviations that nothing uses: {', '.join(unused)}; a diagnosis uses those of "
    return [Finding("NOTE", text + f"{', '.join(USED_SIGMAS)}, of effects and of markers")]
