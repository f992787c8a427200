"""Is what an experiment declares likely? Findings about values that can be, but are mostly another unit."""

from __future__ import annotations

import numpy as np

from livedeform.common.checks.finding import Finding
from livedeform.common.experiment.schema import USED_SIGMAS, Experiment
from livedeform.common.experiment.surface import Surface

COLLAPSE = 5.0  # weight of a column as high as the body over its modulus: all but flat layers are crushed by it
STEEP = 1.0  # rad, of a tilt


def check_declared(experiment: Experiment, body: Surface) -> list[Finding]:
    """Doubt a body that its own weight crushes, and a tilt of gravity that is in degrees by all likelihood; name the
    standard deviations that nothing uses."""
    return [*_weight(experiment, body), *_tilt(experiment), *_unused(experiment)]


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
