"""The `Physics` that the solver takes, from what an experiment declares."""

from __future__ import annotations

import numpy as np

from livedeform.common.experiment.schema import Probe as DeclaredProbe
from livedeform.common.experiment.yaml_file import Experiment
from livedeform.fem_node.contact.probe_shapes import Shape, make_shape
from livedeform.fem_node.physics.record import DeadLoad, MaterialSpec, Physics, Probe, Support, TemperatureCurve


def declared_physics(experiment: Experiment) -> Physics:
    """Return the declared model, without effects."""
    phantom, material = experiment.phantom, experiment.phantom.material
    return Physics(
        material=MaterialSpec(material.model, material.youngs_modulus, material.poisson_ratio, material.parameters),
        density=phantom.density,
        gravity=np.array(phantom.gravity, float),
        scan_gravity=np.array(phantom.scan_gravity, float),
        scan_fraction=1.0 if phantom.configuration == "loaded" else 0.0,
        supports=tuple(Support(s.region.contains, s.type) for s in phantom.support),
        loads=tuple(
            DeadLoad(load.name, load.region.contains, np.array(load.force, float)) for load in experiment.loads
        ),
        release=experiment.timeline.release,
        clock_start_ns=experiment.timeline.clock_start_ns,
        probe=_probe(experiment),
        temperature=_temperature(experiment),
    )


def _temperature(experiment: Experiment) -> TemperatureCurve | None:
    if experiment.temperature is None or experiment.temperatures is None:
        return None
    return TemperatureCurve(*experiment.temperatures, reference=experiment.temperature.reference)


def probe_shape(probe: DeclaredProbe) -> Shape:
    """Return the shape of a declared probe, in the probe's frame."""
    return make_shape(probe.shape.kind, getattr(probe.shape, probe.shape.kind), probe.edge_radius)


def _probe(experiment: Experiment) -> Probe | None:
    probe = experiment.probe
    if probe is None:
        return None
    return Probe(probe_shape(probe), formulation=probe.contact.formulation, friction=probe.contact.friction)
