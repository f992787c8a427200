"""experiment.yaml: what it says comes through, and every mistake is one line with the key and the remedy."""

import copy
import json
import re
import shutil

import numpy as np
import pytest
import trimesh
import yaml

from livedeform.common.checks.declared import check_declared
from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.errors import InputError
from livedeform.common.experiment.plausibility import read_body
from livedeform.common.experiment.schema import USED_SIGMAS
from livedeform.common.experiment.yaml_file import json_schema, load_experiment, save_experiment
from livedeform.common.types import EffectValues
from livedeform.fem_node.effects import EFFECTS


def complaint(folder, **options) -> str:
    with pytest.raises(InputError) as caught:
        load_experiment(folder, **options)
    line = str(caught.value)
    assert "\n" not in line
    assert caught.value.remedy, "every error has a remedy"
    return line


# --- what is right ---------------------------------------------------------------------------------------------------


def test_everything_that_the_file_says_comes_through(folder):
    experiment = load_experiment(folder)
    assert experiment.folder == folder.resolve()
    assert experiment.phantom.surface == folder.resolve() / "block.stl"
    assert experiment.phantom.material.youngs_modulus == 4000.0
    assert experiment.phantom.support[0].type == "fixed"
    assert experiment.markers.ids.tolist() == [1, 2, 5, 7]
    assert experiment.markers.ids.dtype == np.uint32
    assert experiment.markers.points[2].tolist() == [0.0, 0.0, 0.05]
    assert experiment.markers.kinds.tolist() == ["surface", "surface", "surface", "internal"]
    assert np.isnan(experiment.markers.sigmas).all()
    assert experiment.lesions[0].name == "t1"
    assert experiment.probe.shape.kind == "box"
    assert experiment.stereo.pose == "registered"
    assert experiment.loads[0].force == (0.0, 0.0, -0.5)


def test_defaults(change):
    for key in ("probe", "stereo", "loads", "timeline", "effects"):
        folder = change(key, ...)
    folder = change("phantom.lesions", ...)
    experiment = load_experiment(folder)
    assert experiment.probe is None and experiment.stereo is None
    assert experiment.loads == () and experiment.effects == () and experiment.lesions == ()
    assert experiment.timeline.release == 0.0
    assert experiment.thresholds.error == 0.005


def test_scan_gravity_is_gravity_where_it_is_absent(change):
    assert load_experiment(change("phantom.gravity", [0.0, 9.81, 0.0])).phantom.scan_gravity == (0.0, 9.81, 0.0)
    assert load_experiment(change("phantom.scan_gravity", [0.0, 0.0, -9.81])).phantom.scan_gravity == (0.0, 0.0, -9.81)


def test_the_documented_example_is_valid(folder):
    """The YAML of the published interface, word for word, but for its files."""
    text = (folder / "experiment.yaml").read_text()
    published = """
version: 1
name: breast-phantom
phantom:
  surface: block.stl            # closed triangle surface (stl/obj/ply)
  unit: m
  configuration: loaded
  element_size: 0.006
  density: 1000.0
  material: {model: neo_hookean, youngs_modulus: 4000.0, poisson_ratio: 0.49}
  gravity: [0.0, 0.0, -9.81]
  scan_gravity: [0.0, 0.0, -9.81]
  support:
    - {region: {below_z: 0.001}, type: fixed}
  markers: markers.csv
  lesions:
    - {name: t1, centre: [0.0, 0.01, 0.03], diameter: 0.02}
probe:
  shape: {box: [0.060, 0.015, 0.040]}
  edge_radius: 0.002
  contact: {formulation: lagrange, friction: 0.0}
stereo:
  left: left.yaml
  right: right.yaml
  pose: registered
  detector: {type: blob}
loads:
  - {name: weight, region: {above_z: 0.049}, force: [0.0, 0.0, -0.5]}
timeline: {release: 0.0}
effects: [{name: viscoelasticity, g: [0.3], tau: [2.0]}]
thresholds: {error: 0.005}
"""
    (folder / "experiment.yaml").write_text(published)
    experiment = load_experiment(folder)
    assert experiment.effects[0].name == "viscoelasticity"
    assert experiment.effects[0].values["tau"].tolist() == [2.0]
    assert text != published


@pytest.mark.parametrize(
    ("text", "value"), [("4e3", 4000.0), ("4E3", 4000.0), ("+4.e3", 4000.0), ("'4000'", 4000.0), ("4_000", 4000.0)]
)
def test_a_number_may_be_written_in_any_way_with_its_companion_beside_it(folder, text, value):
    """YAML 1.1 reads 4e3 as a text."""
    written = (folder / "experiment.yaml").read_text()
    new = written.replace("youngs_modulus: 4000.0,", f"youngs_modulus: {text}, youngs_modulus_sigma: 2e2,")
    new = new.replace("effects: []", "effects: [{name: viscoelasticity, g: [3e-1], tau: [2e0], tau_sigma: [1e-1]}]")
    new = new.replace("model: neo_hookean,", "model: yeoh, c2_ratio: 1e-1,")
    new += "temperature: {time: [0, 1e2], value: [2e1, 21], reference: 2e1}\n"
    (folder / "experiment.yaml").write_text(new)
    experiment = load_experiment(folder)
    material = experiment.phantom.material
    assert material.youngs_modulus == value and experiment.sigma("phantom.material.youngs_modulus") == 200.0
    assert material.parameters == {"c2_ratio": 0.1} and experiment.temperatures == ((0.0, 100.0), (20.0, 21.0))
    assert experiment.effects[0].values["g"].tolist() == [0.3] and experiment.effects[0].sigmas["tau"].tolist() == [0.1]


def test_a_name_may_look_like_a_number(change):
    change("name", "4e3")
    change("loads.0.name", "2e1")
    experiment = load_experiment(change("timeline", {"clock_start_ns": "1700000000000000001"}))
    assert (experiment.name, experiment.loads[0].name) == ("4e3", "2e1")
    assert experiment.timeline.clock_start_ns == 1_700_000_000_000_000_001


@pytest.mark.parametrize("text", ["04000", "-04000", "0_4000"])
def test_a_number_with_a_leading_zero_is_not_read_to_the_base_8(folder, text):
    document = (folder / "experiment.yaml").read_text()
    (folder / "experiment.yaml").write_text(document.replace("youngs_modulus: 4000.0", f"youngs_modulus: {text}"))
    line = complaint(folder)
    assert f"experiment.yaml:10: {text} begins with a zero, and is read as 2048" in line
    for same in ("0900.0", "'04000'", "4000"):  # no octal numbers
        (folder / "experiment.yaml").write_text(document.replace("youngs_modulus: 4000.0", f"youngs_modulus: {same}"))
        load_experiment(folder)


def test_sigma_companions(change):
    change("phantom.material.youngs_modulus_sigma", 200.0)
    change("phantom.density_sigma", 5)
    folder = change("loads.0.force_sigma", 0.01)
    experiment = load_experiment(folder)
    assert experiment.sigma("phantom.material.youngs_modulus") == 200.0
    assert experiment.sigma("phantom.density") == 5.0
    assert experiment.sigma("loads.0.force") == 0.01
    assert experiment.sigma("phantom.material.poisson_ratio") is None
    assert experiment.sigma("timeline.release") is None


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("phantom.material.youngs_modulus", "4000 Pa", "'4000 Pa'"),
        ("phantom.density", True, "'true' is not a number"),
        ("probe.edge_radius", "2 mm", "'2 mm'"),
    ],
)
def test_a_wrong_number_is_named_with_and_without_its_standard_deviation(change, key, value, said):
    change(f"{key}_sigma", 1e-4)
    line = complaint(change(key, value))
    assert said in line and key.rpartition(".")[2] in line and "is no physical quantity" not in line


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("phantom.gravity", [0.0, -9.81], "phantom.gravity: has too few entries, 2"),
        ("phantom.gravity", [0.0, 0.0, -9.81, 0.0], "phantom.gravity: has too many entries"),
        ("phantom.support", [], "phantom.support: should have an entry"),
    ],
)
def test_lists_of_another_length_are_said_in_plain_words(change, key, value, said):
    assert said in complaint(change(key, value))


def test_a_tab_is_called_so(folder):
    document = (folder / "experiment.yaml").read_text()
    (folder / "experiment.yaml").write_text(document.replace("  density", "\tdensity"))
    assert "write spaces instead of tabs" in complaint(folder)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("version_sigma", 1), ("name_sigma", 1.0), ("loads_sigma", 1.0), ("effects_sigma", 1.0), ("probe_sigma", 1.0),
        ("phantom.support_sigma", 1.0), ("phantom.element_size_sigma", 0.001), ("phantom.surface_sigma", 1.0),
        ("phantom.support.0.region_sigma", 1.0), ("timeline.clock_start_ns_sigma", 1.0),
        ("thresholds.error_sigma", 1.0),
    ],
)  # fmt: skip
def test_what_is_no_quantity_has_no_standard_deviation(change, key, value):
    change("timeline", {"release": 0.0, "clock_start_ns": 5})
    change("effects", [{"name": "stiffness", "ratio": 1.2}])
    change("thresholds", {"error": 0.005})
    line = complaint(change(key, value))
    assert f"'{key.removesuffix('_sigma').rpartition('.')[2]}' is no physical quantity" in line
    assert "phantom.material.youngs_modulus, phantom.material.poisson_ratio, timeline.release" in line


def test_standard_deviations_that_nothing_uses_are_told(change):
    for key in ("phantom.density_sigma", "phantom.gravity_sigma", "loads.0.force_sigma", "probe.edge_radius_sigma"):
        change(key, 0.01)
    folder = change("recordings", {"a*": {"release": 0.2, "release_sigma": 0.02}})
    experiment = load_experiment(folder)
    assert experiment.sigmas["phantom.density"] == 0.01 and experiment.sigmas["recordings.a*.release"] == 0.02
    (finding,) = [f for f in check_declared(experiment, read_body(experiment)) if "standard deviations" in f.text]
    unused = "phantom.gravity, probe.edge_radius, loads.0.force, recordings.a*.release; a diagnosis"
    assert finding.level == "NOTE" and unused in finding.text


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("thresholds", {"error": 0.02}, "thresholds.error is 20 mm, of a body of"),
        ("phantom.gravity", [0.0, 0.0, -1.0], "phantom.gravity is 1 m/s2"),
    ],
)
def test_what_is_in_another_unit_by_all_likelihood_is_doubted(change, key, value, says):
    experiment = load_experiment(change(key, value))
    found = [f for f in check_declared(experiment, read_body(experiment)) if f.level == "WARN"]
    assert any(says in f.text for f in found)
    assert key != "thresholds" or any(f.doubts for f in found)  # no verdict is OK by it


@pytest.mark.parametrize(("key", "value"), [("thresholds", {"error": 0.005}), ("phantom.gravity", [0.0, 0.0, 0.0]),
                                            ("phantom.gravity", [9.81, 0.0, 0.0])])  # fmt: skip
def test_what_is_usual_is_not_doubted(change, key, value):
    experiment = load_experiment(change(key, value))
    assert all(f.level == "NOTE" for f in check_declared(experiment, read_body(experiment)))


def test_two_markers_at_one_place_are_doubted(folder):
    (folder / "markers.csv").write_text("id,x,y,z\n4,0.03,0,0.02\n9,0,0.03,0.02\n6,0.03,0,0.02\n")
    experiment = load_experiment(folder)
    (found,) = [f for f in check_declared(experiment, read_body(experiment)) if "one place" in f.text]
    assert "markers 4 and 6 at one place" in found.text and found.doubts


def material(model, **constants):
    return {"model": model, "youngs_modulus": 4000.0, "poisson_ratio": 0.49, **constants}


@pytest.mark.parametrize(
    ("mu", "alpha", "says"),
    [
        ([1000.0, -300.0], [2.0, -2.0], "give mu alpha / 2: [1000, 300]"),
        ([500.0, -500.0], [2.0, -2.0], "give mu alpha / 2: [500, 500]"),
        ([1000.0, -300.0], [2.0, 4.0], "leave the term out"),
        ([0.0, 0.0], [2.0, -2.0], "the sum of mu of the model ogden is not positive"),
        ([1.0, 1.0], [2.0, 0.0], "an alpha of the model ogden is 0"),
    ],
)
def test_ogden_s_constants_are_judged_by_the_formula_that_they_are_used_in(change, mu, alpha, says):
    assert says in complaint(change("phantom.material", material("ogden", mu=mu, alpha=alpha)))


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (material("yeoh", c1=2000.0, c2=500.0), r"4000 Pa.*1342 Pa.*times 0\.336.*youngs_modulus as 1\.192e\+04"),
        (material("mooney_rivlin", c10=1000.0, c01=500.0), r"\(c10, c01\).*3000 Pa.*1342 Pa"),
        (material("ogden", mu=[3000.0, 500.0], alpha=[2.0, -2.0]), "3500 Pa.*1342 Pa"),
        (material("ogden", mu=[400.0, 471.1], alpha=[2.0, 4.0]), r"Ogden's own formula.*\[400, 942\.2\]"),
        (material("yeoh", c1=671.0, c2=100.0), None),
        (material("yeoh", c1=1.0, c2=0.2), None),
        (material("yeoh", c2_ratio=0.2), None),
        (material("mooney_rivlin", c10=0.8, c01=0.2), None),
        (material("ogden", mu=[1.0, 1.0], alpha=[2.0, -2.0]), None),
        (material("ogden", mu=[1000.0, 340.0], alpha=[2.0, -2.0]), None),
        (material("neo_hookean"), None),
    ],
)
def test_constants_in_pascals_that_contradict_the_modulus_are_doubted(change, given, says):
    """They are scaled to it, which is right for ratios; of constants in Pa one of the two numbers is wrong."""
    experiment = load_experiment(change("phantom.material", given))
    found = [f for f in check_declared(experiment, read_body(experiment)) if "phantom.material" in f.text]
    assert len(found) == (says is not None)
    assert all(f.level == "WARN" and re.search(says, f"{f.text}; {f.remedy}") for f in found)


@pytest.mark.parametrize(("end", "doubted"), [(0.0, False), (0.03, True), (-0.03, True), (0.00005, False)])
def test_a_probe_s_mesh_in_another_frame_than_the_probe_s_is_doubted(folder, change, end, doubted):
    """The contact face lies at z = 0 of the frame 'probe', and the probe behind it at z <= 0."""
    box = trimesh.creation.box((0.03, 0.014, 0.03)).apply_translation((0.0, 0.0, end - 0.015))
    box.export(folder / "probe.stl")
    experiment = load_experiment(change("probe", {"shape": {"mesh": "probe.stl"}}))
    found = [f for f in check_declared(experiment, read_body(experiment)) if "probe.shape.mesh" in f.text]
    assert bool(found) == doubted
    assert all(f.level == "WARN" and f"ends at z = {1e3 * end:+.3g} mm" in f.text for f in found)


@pytest.mark.parametrize(("factor", "says"), [(1000.0, "but the body is"), (None, "not closed")])
def test_a_probe_s_mesh_that_cannot_be_is_refused(folder, change, factor, says):
    box = trimesh.creation.box((0.03, 0.014, 0.03)).apply_translation((0.0, 0.0, -0.015))
    if factor is None:
        box = trimesh.Trimesh(box.vertices, box.faces[2:], process=False)
    else:
        box.apply_scale(factor)
    box.export(folder / "probe.stl")
    assert says in complaint(change("probe", {"shape": {"mesh": "probe.stl"}}))


def test_places_of_markers_in_millimetres_are_refused(folder):
    """Of a body of 98 mm; up to the body's own size they were taken as they are, and any error was allowed for."""
    (folder / "markers.csv").write_text("id,x,y,z,sigma\n1,0,0,0.05,0.05\n")
    assert "sigma is 0.05 m, but the body is 0.0985 m across" in complaint(folder)


def test_those_that_are_said_to_be_used_are(change):
    stated = {p.stated_by for effect in EFFECTS.values() for p in effect.INFO.parameters if p.stated_by}
    assert {*stated, "timeline.release"} == set(USED_SIGMAS)


def test_a_number_in_scientific_notation_without_a_point_is_a_number(change):
    folder = change("phantom.density", 1000.0)
    text = (folder / "experiment.yaml").read_text().replace("4000.0", "4e3")  # YAML 1.1 reads the text "4e3"
    (folder / "experiment.yaml").write_text(text)
    assert load_experiment(folder).phantom.material.youngs_modulus == 4000.0


@pytest.mark.parametrize(
    ("region", "inside", "outside"),
    [
        ({"below_z": 0.01}, [0, 0, 0.01], [0, 0, 0.011]),
        ({"above_z": 0.04}, [0, 0, 0.05], [0, 0, 0.03]),
        ({"box": [[-0.1, -0.1, -0.1], [0.0, 0.1, 0.1]]}, [-0.01, 0, 0], [0.01, 0, 0]),
        ({"sphere": {"centre": [0.03, 0, 0], "radius": 0.01}}, [0.03, 0.009, 0], [0.03, 0.011, 0]),
        ({"plane": {"point": [0, 0, 0.05], "normal": [0, 0, 2], "tolerance": 0.001}}, [1, 1, 0.0491], [0, 0, 0.0489]),
    ],
)
def test_regions(change, region, inside, outside):
    experiment = load_experiment(change("phantom.support.0.region", region))
    contains = experiment.phantom.support[0].region.contains(np.array([inside, outside], float))
    assert contains.tolist() == [True, False]


# --- what is wrong ---------------------------------------------------------------------------------------------------

MATERIAL = {"model": "yeoh", "youngs_modulus": 4000.0, "poisson_ratio": 0.49}
MISTAKES = [
    ("phantom.elment_size", 0.01, "unknown key 'elment_size'", "did you mean 'element_size'"),
    ("phantom.material.youngs_module", 1.0, "youngs_module", "did you mean 'youngs_modulus'"),
    ("phantom.material.youngs_modulus_sgima", 1.0, "youngs_modulus_sgima", ""),
    ("prob", {}, "unknown key 'prob'", "did you mean 'probe'"),
    ("phantom.density", ..., "key 'density' is missing", ""),
    ("phantom.element_size", ..., "'element_size' is missing", "metres"),
    ("phantom.surface", "blok.stl", "phantom.surface: the file", "did you mean 'block.stl'"),
    ("phantom.markers", "nothing.csv", "phantom.markers: the file", "relative"),
    ("stereo.left", "links.yaml", "stereo.left: the file", ""),
    ("stereo.right", ..., "only one camera", "neither"),
    ("phantom.unit", "mm", "phantom.unit: with unit mm the body is 6e-05 m", "'unit: m'"),
    ("phantom.unit", "cm", "phantom.unit", ""),
    ("phantom.material.poisson_ratio", 0.5, "poisson_ratio is 0.5, and must be below 0.5", "0.49"),
    ("phantom.material.poisson_ratio", -0.1, "phantom.material.poisson_ratio", ""),
    ("phantom.material.youngs_modulus", 4.0, "4 is not plausible", "4 kPa is 4000"),
    ("phantom.material.youngs_modulus", float("nan"), "phantom.material.youngs_modulus", ""),
    ("phantom.material.youngs_modulus", True, "'true' is not a number", ""),
    ("phantom.material.youngs_modulus_sigma", -3.0, "youngs_modulus_sigma", "standard deviation"),
    ("phantom.material.model", "neohookean", "unknown material model", "did you mean 'neo_hookean'"),
    ("phantom.material", {**MATERIAL, "c1": "soft"}, "'c1' is 'soft'", "number"),
    ("phantom.material", {**MATERIAL, "c4": 1.0}, "unknown key 'c4' of the model yeoh", "known are .*c2"),
    ("phantom.material", {**MATERIAL, "model": "mooney_rivlin", "c10": 1.0}, "only one of c10 and c01", "both"),
    ("phantom.density", 1.0, "phantom.density: 1 is not plausible", "1 g/cm3 is 1000"),
    ("phantom.gravity", [0, 0, -9810.0], "gravity of 9810", "m/s2"),
    ("phantom.gravity", [0, 0], "phantom.gravity", ""),
    ("phantom.element_size", 6.0, "6 is not plausible", "6 mm is 0.006"),
    ("phantom.element_size", 0.04, "more than half of the body", "0.0"),
    ("phantom.element_size", 0.00001, "tetrahedra", "0.0"),
    ("phantom.configuration", "loadd", "phantom.configuration", ""),
    ("phantom.mesh", "block.stl", "both are given", "one file"),
    ("phantom.support", [], "phantom.support", ""),
    ("phantom.support.0.region", {"below_z": 1}, "holds the whole body", "1 mm is 0.001"),
    ("phantom.support.0.region", {"below_z": -0.01}, "touches no part of the body", "correct"),
    ("phantom.support.0.region", {"below_z": 0.01, "above_z": 0.02}, "below_z and above_z", "one of"),
    ("phantom.support.0.region", {}, "here is nothing", "one of"),
    (
        "phantom.support.0.region",
        {"box": [[-0.01, -0.01, 0.02], [0.01, 0.01, 0.03]]},
        "lies inside its surface",
        "correct",
    ),
    ("phantom.support.0.region", {"sphere": {"centre": [0.2, 0, 0], "radius": 0.01}}, "touches no part", ""),
    ("phantom.support.0.region", {"box": [[0, 0, 0], [0, 1, 1]]}, "first corner", ""),
    ("phantom.support.0.type", "glued", "phantom.support.0.type", ""),
    ("phantom.lesions.0.centre", [0, 0, 0.08], "lesion 't1' lies outside", "metres"),
    ("phantom.lesions.0.diameter", 20.0, "not plausible", "metres"),
    ("probe.shape", {"box": [60, 15, 40]}, "60 is not plausible", "metres"),
    ("probe.shape", {"box": [0.06, 0.015, 0.04], "sphere": 0.01}, "box and sphere", "one of"),
    ("probe.edge_radius", 0.01, "more than half", "smaller"),
    ("probe.contact", {"formulation": "nitsche"}, "probe.contact.formulation", ""),
    ("stereo.pose", {"position": [0, 0, 400], "orientation_xyzw": [0, 0, 0, 1]}, "400 m away", "metres"),
    ("probe.contact", {"friction": 300}, "probe.contact.friction", "coefficient"),
    ("stereo.pose", {"position": [0, 0, 0], "orientation_xyzw": [1, 1, 0, 0]}, "quaternion", "norm 1"),
    ("loads.0.region", {"above_z": 0.2}, "loads.0.region", "correct"),
    ("timeline.release", -1.0, "timeline.release", ""),
    ("version", 2, "version", ""),
    ("effects", [{"name": "viscoelastic", "g": [0.1]}], "unknown effect", "did you mean 'viscoelasticity'"),
    ("effects", [{"name": "stiffness", "ration": 2.0}], "has no parameter 'ration'", "did you mean 'ratio'"),
    ("effects", [{"name": "viscoelasticity", "g": [0.1]}], "lacks tau", "every parameter"),
    ("effects", [{"name": "viscoelasticity", "g": [0.1], "tau": [1.0], "held": 5.0}], "is let go", "timeline.release"),
    ("effects", [{"name": "viscoelasticity", "g": [0.1], "tau": [1.0], "held_sigma": 5.0}], "not given", "both"),
    ("effects", [{"name": "stiffness", "ratio": "high"}], "'high'", "number"),
    ("effects", [{"name": "viscoelasticity", "g": [g], "tau": [2.0]} for g in (0.3, 0.2)], "2 times", "several terms"),
    ("effects", [{"name": "stiffness", "ratio": [1.0, 2.0]}], "'ratio'", "write one number"),
    ("effects", [{"name": "stiffness", "ratio": 10**400}], "'ratio'", "number"),
    ("effects", [{"name": "probe_offset", "translation": 0.1}], "'translation'", "a list of 3 numbers"),
    ("effects", ["stiffness"], "mapping with a 'name'", "ratio"),
]


@pytest.mark.parametrize(("key", "value", "says", "remedy"), MISTAKES)
def test_a_mistake_is_one_line_with_key_and_remedy(change, key, value, says, remedy):
    folder = change(key, value)
    line = complaint(folder)
    assert says in line
    assert re.search(remedy, line)
    assert "experiment.yaml" in line or "markers.csv" in line


def test_schema_mistakes_name_the_line(folder):
    text = (folder / "experiment.yaml").read_text().replace("density: 1000.0", "density: heavy")
    (folder / "experiment.yaml").write_text(text)
    number = 1 + text.splitlines().index("  density: heavy")
    assert f"experiment.yaml:{number}: phantom.density" in complaint(folder)


def test_yaml_syntax_error_names_the_line(folder):
    text = (folder / "experiment.yaml").read_text().replace("gravity: [0.0, 0.0, -9.81]", "gravity: [0.0, 0.0, -9.81")
    (folder / "experiment.yaml").write_text(text)
    assert re.search(r"experiment.yaml:\d+: not valid YAML", complaint(folder))


def test_a_doubled_key_is_refused(folder):
    with (folder / "experiment.yaml").open("a") as file:
        file.write("name: again\n")
    assert "'name' is there twice" in complaint(folder)


def test_a_folder_without_an_experiment(tmp_path):
    assert "experiment.yaml: the experiment does not exist" in complaint(tmp_path)


@pytest.mark.parametrize("text", ["", "- 1\n- 2\n", "version"])
def test_a_file_that_is_no_mapping(folder, text):
    (folder / "experiment.yaml").write_text(text)
    assert "is not a mapping" in complaint(folder)


def test_an_open_surface(folder):
    block = trimesh.load_mesh(folder / "block.stl")
    block.update_faces(np.arange(len(block.faces)) > 0)
    block.export(folder / "block.stl")
    line = complaint(folder)
    assert "block.stl" in line and "not closed: 3 of" in line and "close the holes" in line


def test_a_surface_of_metres_in_a_file_of_millimetres(folder):
    block = trimesh.load_mesh(folder / "block.stl")
    block.apply_scale(1000.0)
    block.export(folder / "block.stl")
    line = complaint(folder)
    assert "phantom.unit: with unit m the body is 60 m across" in line and "'unit: mm'" in line


def test_a_file_that_is_no_surface(folder):
    (folder / "block.stl").write_text("solid nothing\nendsolid\n")
    assert "block.stl" in complaint(folder)


def test_an_inside_out_surface_is_turned(folder):
    block = trimesh.load_mesh(folder / "block.stl")
    block.invert()
    block.export(folder / "block.stl")
    load_experiment(folder)  # the lesion would lie outside otherwise


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ("1,0.03,0,0.02\n1,0,0.03,0.02\n", "marker id 1 is there twice"),
        ("1,0.03,0,0.02\n2,0,nan,0.02\n", "y is 'nan', not a number"),
        ("1,0.03,0,0.02\n2,0,,0.02\n", "y is '', not a number"),
        ("1,0.03,0,0.02\n2.5,0,0,0.02\n", "id '2.5' is not a whole number"),
        ("1,0.03,0,0.02\n2,0,0,0.2\n", "marker 2 is 0.15 m from the body"),
        ("1,30,0,20\n2,0,30,20\n3,0,0,50\n", "divide them by 1000"),
        ("1,3e-5,0,2e-5\n2,0,3e-5,2e-5\n3,0,0,5e-5\n4,0,0,4e-5\n", "check the unit"),
        ("", "holds no markers"),
    ],
)
def test_mistakes_in_the_markers(folder, rows, says):
    (folder / "markers.csv").write_text("id,x,y,z\n" + rows)
    line = complaint(folder)
    assert says in line and "markers.csv" in line


def test_a_missing_column(folder):
    (folder / "markers.csv").write_text("id,x,y\n1,0,0\n")
    assert "column z is missing" in complaint(folder)


def test_internal_markers_are_inside(folder):
    (folder / "markers.csv").write_text("id,x,y,z,kind\n1,0,0,0.055,internal\n")
    assert "marker 1 is called internal, but lies outside" in complaint(folder)
    (folder / "markers.csv").write_text("id,x,y,z,kind\n1,0,0,0.055,surface\n")
    load_experiment(folder)  # a ball on the skin


def test_markers_on_the_table_may_be_farther_off(folder):
    (folder / "markers.csv").write_text("id,x,y,z,kind\n1,0,0,0.05,surface\n2,0.15,0,0,surface\n")
    assert "marker 2 is 0.12 m from the body" in complaint(folder)
    (folder / "markers.csv").write_text("id,x,y,z,kind\n1,0,0,0.05,surface\n2,0.15,0,0,support\n")
    load_experiment(folder)


@pytest.mark.parametrize("header", ["id,x,y,z,kind", "ID, X, Y, Z, Kind", "# one kind\n\nkind,id,x,y,z", "id,x,y,z"])
def test_whether_kinds_are_stated_is_told_by_the_columns(folder, header):
    row = "internal,1,0,0,0.02" if "kind,id" in header else "1,0,0,0.02,internal"
    row = row.removesuffix(",internal") if header == "id,x,y,z" else row
    (folder / "markers.csv").write_text(f"# measured by hand, no kind\n{header}\n{row}\n")
    markers = load_experiment(folder).markers
    assert markers.kinds_stated == ("kind" in header.lower().splitlines()[-1])
    assert markers.kinds.tolist() == ["internal" if markers.kinds_stated else "surface"]


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("kinds", "kind"),
        ("Knid", "kind"),
        ("sigmas", "sigma"),
        ("sgima", "sigma"),
        ("sigma_mm", "sigma"),
        ("sigma (mm)", "sigma"),
        ("sigma/mm", "sigma"),
        ("sigma in mm", "sigma"),
        ("Sigmamm", "sigma"),
        ("sigma [\u03bcm]", "sigma"),  # Greek mu, and the sign of micro
        ("sigma [\u00b5m]", "sigma"),
        ("sigma_position", "sigma"),
        ("\u03c3 / mm", "sigma"),
        ("\uff53\uff49\uff47\uff4d\uff41", "sigma"),  # the same letters in full width
        ("\uff4bind", "kind"),
    ],
)
def test_a_mistyped_column_is_not_left_out_in_silence(folder, name, wanted):
    (folder / "markers.csv").write_text(f"id,x,y,z,{name}\n1,0,0,0.02,\n")
    assert f"a column '{name.strip()}' is not read; call it {wanted}" in complaint(folder)


@pytest.mark.parametrize("name", ["sigma_x", "note", "X", "find", "type"])
def test_other_columns_are_left_out(folder, name):
    (folder / "markers.csv").write_text(f"id,x,y,z,{name}\n1,0,0,0.05,what\n")
    assert load_experiment(folder).markers.ids.tolist() == [1]


def test_a_mistake_in_the_markers_has_its_own_line(folder):
    """Comments and empty lines count, too."""
    for row, says in (("2,0,up,0.02", "y is 'up'"), ("1,0,0,0.05", "marker id 1 is there twice"), ("2,1", "y is ''")):
        (folder / "markers.csv").write_text(f"# by hand\nid,x,y,z\n\n1,0,0,0.05\n# the second\n{row}\n")
        line = complaint(folder)
        assert "markers.csv:6: " in line and says in line


def test_an_unknown_kind_of_marker(folder):
    (folder / "markers.csv").write_text("id,x,y,z,kind\n1,0,0,0.05,deep\n")
    assert "unknown kind 'deep'" in complaint(folder)


def test_regions_of_a_body_may_be_several(change):
    ball = {"name": "inclusion", "radius": 0.005, "ratio": 5.0}
    balls = [ball | {"centre": [x, 0.0, 0.02]} for x in (-0.02, 0.02)]
    assert len(load_experiment(change("effects", [*balls, {"name": "stiffness", "ratio": 1.2}])).effects) == 3


def test_effects_against_a_registry(change):
    folder = change("effects", [{"name": "glue", "strength": 3.0}])
    assert "unknown effect 'glue'" in complaint(folder)
    glue = EffectInfo("glue", "support", "", "", "", (Parameter("strength", "Pa", 1.0, 0.0, 9.0, 1.0),))
    assert load_experiment(folder, effects={"glue": glue}).effects[0].values["strength"] == 3.0


JUNK = [
    ...,
    [],
    {},
    None,
    "x",
    "1e-3",
    -1,
    0,
    1e9,
    10**400,
    float("nan"),
    float("inf"),
    True,
    [1, 2],
    [[]],
    {"a": 1},
    "e\n",
]


def key_paths(node, path=()):
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, child in items:
        yield (*path, key)
        yield from key_paths(child, (*path, key))


def test_whatever_stands_in_a_key_is_read_or_refused_in_one_line(folder, rng):
    """120 of the 1406 pairs of key and junk, by chance; all of them were tried once: 1290 refused, 116 read."""
    original = yaml.safe_load((folder / "experiment.yaml").read_text())
    original["effects"] = [{"name": "viscoelasticity", "g": [0.3], "tau": [2.0]}]
    original["stereo"]["pose"] = {"position": [0, 0, 0], "orientation_xyzw": [0, 0, 0, 1]}
    pairs = [(path, junk) for path in key_paths(original) for junk in JUNK]
    for i in rng.choice(len(pairs), 120, replace=False):
        path, junk = pairs[i]
        document = copy.deepcopy(original)
        section = document
        for key in path[:-1]:
            section = section[key]
        if junk is ...:
            del section[path[-1]]
        else:
            section[path[-1]] = junk
        (folder / "experiment.yaml").write_text(yaml.safe_dump(document))
        try:
            save_experiment(load_experiment(folder), folder / "again.yaml")
            load_experiment(folder / "again.yaml")
        except InputError as error:
            assert "\n" not in str(error) and error.remedy, (path, junk)


# --- writing ---------------------------------------------------------------------------------------------------------


def test_a_fitted_experiment_loads_from_another_folder(folder, tmp_path, change):
    change("phantom.material.youngs_modulus_sigma", 200.0)
    fitted = [
        EffectValues("stiffness", {"ratio": np.array(1.2)}, {"ratio": np.array(0.03)}),
        EffectValues("viscoelasticity", {"g": np.array([0.3]), "tau": np.array([2.0])}),
    ]
    elsewhere = tmp_path / "result"
    elsewhere.mkdir()
    experiment = load_experiment(folder)
    save_experiment(experiment, elsewhere / "experiment.fitted.yaml", effects=fitted)
    again = load_experiment(elsewhere / "experiment.fitted.yaml")
    assert again.phantom.surface == experiment.phantom.surface
    assert again.stereo.left == experiment.stereo.left
    assert again.phantom.material == experiment.phantom.material
    assert again.sigma("phantom.material.youngs_modulus") == 200.0
    assert [e.name for e in again.effects] == ["stiffness", "viscoelasticity"]
    assert again.effects[0].values["ratio"] == 1.2 and again.effects[0].sigmas["ratio"] == 0.03
    assert again.effects[1].values["g"].tolist() == [0.3]


def test_an_experiment_saved_in_its_own_folder_moves_with_it(folder, tmp_path):
    save_experiment(load_experiment(folder), folder / "experiment.fitted.yaml")
    moved = tmp_path / "moved"
    shutil.move(folder, moved)
    assert load_experiment(moved / "experiment.fitted.yaml").phantom.surface == moved.resolve() / "block.stl"


def test_json_schema_describes_the_keys():
    schema = json_schema()
    phantom = schema["$defs"]["Phantom"]["properties"]
    assert {"surface", "mesh", "material", "density", "density_sigma", "support"} <= set(phantom)
    assert "youngs_modulus_sigma" in schema["$defs"]["Material"]["properties"]
    assert schema["required"] == ["version", "name", "phantom"]
    json.dumps(schema)


def test_a_tetrahedral_mesh_instead_of_a_surface(folder, change):
    import meshio

    corners = np.array([[x, y, z] for x in (-0.03, 0.03) for y in (-0.03, 0.03) for z in (0.0, 0.05)])
    tets = np.array([[0, 1, 3, 5], [0, 3, 2, 6], [0, 5, 4, 6], [3, 5, 6, 7], [0, 3, 5, 6]])
    meshio.write_points_cells(folder / "block.vtu", corners, [("tetra", tets)])
    change("phantom.surface", ...)
    change("phantom.element_size", ...)
    experiment = load_experiment(change("phantom.mesh", "block.vtu"))
    assert experiment.phantom.mesh.name == "block.vtu"
    document = yaml.safe_load((folder / "experiment.yaml").read_text())
    assert "surface" not in document["phantom"]
    meshio.write_points_cells(folder / "block.vtu", corners, [("triangle", tets[:, :3])])
    assert "holds no tetrahedra (triangle)" in complaint(folder)
