"""Is what an experiment declares likely? Findings about values that can be, but are mostly another unit."""

from __future__ import annotations

import numpy as np

from livedeform.common.checks.contact.held import check_held
from livedeform.common.checks.finding import Finding
from livedeform.common.experiment.constants import OGDEN_1972, ogden_1972, shear_modulus_of
from livedeform.common.experiment.schema import USED_SIGMAS, Experiment
from livedeform.common.experiment.surface import Surface, read_surface

COLLAPSE = 5.0  # weight of a column as high as the body over its modulus: all but flat layers are crushed by it
STEEP = 1.0  # rad, of a tilt
EARTH = (9.5, 10.1)  # m/s2
LARGE = 0.1  # of the diagonal
RELATIVE = 10.0  # Pa; constants that make a softer body than that can only be meant as ratios
DIFFERS = 0.05  # of a shear modulus
FLUSH = 1e-4  # m; as exactly a mesh may be expected to be drawn
LET, METRES = "nearly nothing is wrong by that", "lengths are in metres: 2 mm is 0.002"


def check_declared(experiment: Experiment, body: Surface) -> list[Finding]:
    """Doubt a body that its own weight crushes, a tilt of gravity that is in degrees and a gravity in another unit by
    all likelihood, constants of a material that contradict its modulus, errors that are large for this body, a probe's
    mesh in another frame than the probe's, and supports that leave the body free to move; name the standard deviations
    that nothing uses."""
    return [
        *_weight(experiment, body),
        *_constants(experiment),
        *_gravity(experiment),
        *_tilt(experiment),
        *_large_errors(experiment, body),
        *_same_places(experiment),
        *_probe_frame(experiment),
        *check_held(experiment, body),
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


def _constants(experiment: Experiment) -> list[Finding]:
    """Doubt constants in Pa that have another stiffness at small strain than E and nu: all are scaled to those."""
    material = experiment.phantom.material
    own = shear_modulus_of(material.model, material.parameters)
    declared = material.youngs_modulus / (2.0 * (1.0 + material.poisson_ratio))
    if own is None or own <= RELATIVE or abs(own / declared - 1.0) <= DIFFERS:
        return []
    given = ", ".join(key for key in ("mu", "c1", "c10", "c01") if key in material.parameters)
    text = (
        f"the constants of phantom.material ({given}) have a shear modulus of {own:.4g} Pa, youngs_modulus and "
        f"poisson_ratio one of {declared:.4g} Pa: all constants are taken times {declared / own:.3g}"
    )
    remedy = f"give youngs_modulus as {own / declared * material.youngs_modulus:.4g}, or correct the constants"
    if material.model == "ogden" and abs(sum(ogden_1972(material.parameters)) / declared - 1.0) <= DIFFERS:
        values = ", ".join(f"{m:.4g}" for m in ogden_1972(material.parameters))
        remedy = f"they fit by Ogden's own formula ({OGDEN_1972}): then give mu as [{values}]"
    return [Finding("WARN", text, remedy)]


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


def _same_places(experiment: Experiment) -> list[Finding]:
    """Doubt two markers at one place, as after a line that was copied."""
    places, ids = experiment.markers.points, experiment.markers.ids
    _, first, again = np.unique(places, axis=0, return_index=True, return_inverse=True)
    doubled = np.flatnonzero(first[again.ravel()] != np.arange(len(ids)))
    if not len(doubled):
        return []
    k = doubled[0]
    more = f", and {len(doubled) - 1} more such" if len(doubled) > 1 else ""
    text = f"markers.csv has markers {ids[first[again.ravel()[k]]]} and {ids[k]} at one place{more}"
    return [Finding("WARN", text, "correct the place of one of them", doubts=True)]


def _tilt(experiment: Experiment) -> list[Finding]:
    found = []
    for effect in experiment.effects:
        if effect.name == "gravity_tilt":
            angle = float(np.hypot(effect.values["angle_x"], effect.values["angle_y"]))
            if angle > STEEP:
                text = f"the effect 'gravity_tilt' turns gravity by {angle:.3g} rad, {np.degrees(angle):.0f} degrees"
                found.append(Finding("WARN", text, "give its angles in radians: 2 degrees are 0.035"))
    return found


def _probe_frame(experiment: Experiment) -> list[Finding]:
    """Doubt a probe's mesh whose contact face is not where its poses say it is: at z = 0, and nothing beyond."""
    mesh = None if experiment.probe is None else experiment.probe.shape.mesh
    end = 0.0 if mesh is None else float(read_surface(mesh).upper[2])
    if abs(end) <= FLUSH:
        return []
    text = (
        f"probe.shape.mesh ends at z = {1e3 * end:+.3g} mm, not at 0: the origin of the frame 'probe' is the middle of "
        "the contact face, +z points out of it into the tissue, and only the rim of a hollow face lies at z > 0"
    )
    return [Finding("WARN", text, "move the mesh, or turn it, or leave it so if its face is hollow")]


def _unused(experiment: Experiment) -> list[Finding]:
    unused = [key for key in experiment.sigmas if key not in USED_SIGMAS]
    if not unused:
        return []
    text = f"standard deviations that nothing uses: {', '.join(unused)}; a diagnosis uses those of "
    return [Finding("NOTE", text + f"{', '.join(USED_SIGMAS)}, of effects and of markers")]
