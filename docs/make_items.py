"""Writes docs/items.md from the docstrings of what the model is put together from, and names the tests of each.

python docs/make_items.py            writes the page
python docs/make_items.py --check    exit code 1 if the page is not what the docstrings say, or a named test is gone
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from livedeform.fem_node.materials import MATERIALS

PAGE = Path(__file__).parent / "items.md"
TESTS = Path(__file__).parents[1] / "tests" / "fem_node"
HEAD = """# What the model is put together from

Equation, source, parameters and tests of every item. This page is written by `python docs/make_items.py` from the
docstrings; do not edit it. Effects have [their own page](effects.md); how good the whole is stands on
[the model's page](model.md). Tests are in `tests/fem_node`.
"""


@dataclass(frozen=True)
class Entry:
    """One section: ``module`` of fem_node whose docstring it shows, ``parts`` of it (classes and functions) that are
    the parameters, ``tests`` as file:function (file:* for all)."""

    title: str
    module: str
    tests: Sequence[str]
    parts: Sequence[str] = ()


EVERY_MATERIAL = ("materials:*",)
MATERIAL_TESTS = {
    "linear": ("reference:test_the_cuboid_is_within_half_a_percent_on_a_live_mesh",),
    "neo_hookean": (
        "reference:test_the_cuboid_is_within_half_a_percent_on_a_live_mesh",
        "exact:test_torsion_of_a_cylinder_has_the_exact_moment",
        "exact:test_inflation_of_a_thick_sphere",
    ),
    "neo_hookean_log": ("reference:test_the_cuboid_is_within_half_a_percent_on_a_live_mesh",),
}
EXACT_FOR_ALL = ("mooney_rivlin", "yeoh", "exponential", "ogden", "neo_hookean")

SECTIONS: dict[str, Sequence[Entry]] = {
    "Body": (
        Entry("Elements", "element.element", ("elements:*",)),
        Entry("Keeping the volume", "element.volume_scheme", (
                  "elements:test_nearly_incompressible_elements_do_not_lock",
                                                      "elements:test_inf_sup_constants")),
        Entry("Inner forces, swelling, fields", "items.continuum",
              ("elements:test_assembled_tangent_is_the_derivative_of_the_residual",
               "history:test_a_free_body_swells_without_stress", "history:test_softening_is_a_smaller_modulus",
               "thermal_expansion:*")),
        Entry("What a body remembers", "physics.memory", ("memory:*",)),
        Entry("Relaxation and creep", "items.viscoelastic",
              ("history:test_relaxation_is_the_prony_series_exactly",
               "history:test_creep_under_a_dead_load_is_the_ordinary_differential_equation",
               "history:test_viscoelastic_history_restarts_from_a_saved_state"), ("physics.record.Prony",)),
        Entry("Plastic set", "items.plastic", ("history:test_plastic_set_leaves_the_declared_share_of_the_strain",),
              ("physics.record.PlasticSet",)),
        Entry("Unloaded shape", "path.unloaded",
              ("model:test_a_loaded_scan_is_its_own_equilibrium",
               "model:test_the_unloaded_shape_loads_back_at_large_strain",
               "model:test_a_loaded_scan_on_a_yielding_support_is_its_own_equilibrium",
               "model:test_a_scan_that_cannot_be_an_equilibrium_is_refused")),
    ),
    "Supports, loads, motion": (
        Entry("Supports", "items.supports", ("supports:*",), ("physics.record.Support", "items.supports.Springs",
                                                        "items.supports.FrictionSupport")),
        Entry("Weight and dead loads", "items.loads", ("model:test_weight_acts_from_the_release_on",
                                                 "exact:test_a_beam_bends_as_the_elastica"),
              ("items.loads.Weight", "physics.record.DeadLoad")),
        Entry("Friction of a load", "items.rubbing_load", ("load_friction:*",)),
        Entry("Inertia and damping", "items.dynamics", ("history:test_a_bar_let_go_swings_as_its_longitudinal_mode",
                                                  "model:test_a_released_body_with_inertia_overshoots"),
              ("physics.record.Inertia",)),
    ),
    "Contact": (
        Entry("Probe shapes", "contact.probe_shapes", ("shapes:*",),
              ("contact.probe_shapes.Box", "contact.probe_shapes.Cylinder",
               "contact.probe_shapes.Sphere",
                                                        "contact.probe_shapes.TriangleSolid")),
        Entry("Contact laws", "contact.law", ("contact_law:*",)),
        Entry("A rigid probe", "contact.contact", ("contact_item:*", "contact_press:*", "contact_reference:*"),
              ("physics.record.Probe",)),
        Entry("Two bodies", "items.two_bodies", ("two_bodies:*",), ("physics.record.Interface",)),
    ),
    "Solving": (
        Entry("Equilibrium", "solve.solver", ("model:test_a_failed_frame_does_not_poison_the_next",
                                        "model:test_an_impossible_weight_is_a_convergence_error_with_a_remedy"),
              ("solve.solver.SolverSettings",)),
        Entry("Sensitivities", "path.tangents", ("sensitivities:*",), ("path.direction.Direction",)),
        Entry("Sensitivities with friction, a set or inertia", "path.followers", ("sensitivities:test_friction",)),
        Entry("Live prediction", "live.live_model", ("live:*",)),
    ),
}  # fmt: skip


def markdown(text: str) -> str:
    """A docstring as markdown: code marks, and tables between lines of = set as they are."""
    lines, table = [], False
    for line in inspect.cleandoc(text).splitlines():
        rule = line.startswith("====")
        table = table or rule
        lines.append("    " + line if table else line)
        table = table and not (rule and len(lines) > 1 and lines[-2].strip() != "")
    return re.sub(r"``([^`]+)``", r"`\1`", "\n".join(lines)).strip()


def material_entries() -> list[str]:
    """A section per row of the materials' registry."""
    out = []
    for name, module in MATERIALS.items():
        tests = [*EVERY_MATERIAL, *MATERIAL_TESTS.get(name, ())]
        if name in EXACT_FOR_ALL:
            tests.append("exact:test_uniaxial_stretch_under_a_dead_load")
            tests.append("exact:test_simple_shear_has_the_exact_stress")
        rows = [f"### {name}", "", markdown(module.__doc__ or ""), ""]
        rows += [markdown(module.make.__doc__ or ""), "", tested(tests), ""]
        out.append("\n".join(rows))
    return out


def section(entry: Entry) -> str:
    """One item."""
    module = importlib.import_module(f"livedeform.fem_node.{entry.module}")
    rows = [f"### {entry.title}", "", markdown(module.__doc__ or ""), ""]
    for part in entry.parts:
        home, _, name = part.rpartition(".")
        text = getattr(importlib.import_module(f"livedeform.fem_node.{home}"), name).__doc__ or ""
        rows.append(f"- `{name}`: " + markdown(text).replace("\n", "\n  ").replace("\n  \n", "\n\n"))
    if entry.parts:
        rows.append("")
    rows += [f"`fem_node/{entry.module.replace('.', '/')}.py`. " + tested(entry.tests), ""]
    return "\n".join(rows)


def tested(tests: Sequence[str]) -> str:
    """Where an item is tested, in words; an error if a named test does not exist."""
    found: dict[str, list[str]] = {}
    for test in tests:
        file, function = test.split(":")
        path = TESTS / f"test_{file}.py"
        if not path.exists() or (
            function != "*" and not re.search(rf"^def {function}\(", path.read_text(), re.MULTILINE)
        ):
            sys.exit(f"there is no test {function} in {path}")
        words = [] if function == "*" else [function.removeprefix("test_").replace("_", " ")]
        found.setdefault(path.name, []).extend(words)
    rows = [f"`{name}`" + (f" ({'; '.join(words)})" if words else "") for name, words in found.items()]
    return "Tested in " + ", ".join(rows) + "."


def page() -> str:
    """The whole page."""
    parts = [HEAD, "## Materials\n"]
    parts.append(markdown(importlib.import_module("livedeform.fem_node.materials.base").__doc__ or "") + "\n")
    parts += material_entries()
    for title, entries in SECTIONS.items():
        parts += [f"## {title}\n", *(section(entry) for entry in entries)]
    return "\n".join(parts).rstrip() + "\n"


if __name__ == "__main__":
    if "--check" in sys.argv:
        sys.exit(0 if PAGE.exists() and PAGE.read_text() == page() else 1)
    PAGE.write_text(page())
