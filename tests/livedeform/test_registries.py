"""The published names, which experiments are checked against, are those that the packages register."""

from livedeform.common.effect import EFFECT_PARAMETERS
from livedeform.common.experiment.schema import MATERIALS as PUBLISHED_MATERIALS
from livedeform.fem_node.effects import EFFECTS as MECHANICAL
from livedeform.fem_node.materials import MATERIALS
from livedeform.stereo_node.effects import EFFECTS as MEASURING


def test_effects():
    registered = {**MECHANICAL, **MEASURING}
    assert {
        name: {p.name: p.size for p in effect.INFO.parameters} for name, effect in registered.items()
    } == EFFECT_PARAMETERS
    assert not set(MECHANICAL) & set(MEASURING)


def test_materials():
    assert set(MATERIALS) == set(PUBLISHED_MATERIALS)
