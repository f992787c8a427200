"""The rules of the layout: who may import whom, and where the foreign libraries live."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from fnmatch import fnmatch
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest

SRC = Path(__file__).parents[1] / "src" / "livedeform"
LAYER = {"common": 0, "stereo_node": 1, "fem_node": 1, "compare_node": 1, "closed_loop": 2}
FACE = 3  # everything else in the package
ROS = ("rclpy", "std_msgs", "sensor_msgs", "geometry_msgs", "visualization_msgs", "diagnostic_msgs",
       "builtin_interfaces", "rosgraph_msgs", "tf2_msgs", "rcl_interfaces", "lifecycle_msgs")  # fmt: skip
WITH_ROS = ("*/node.py", "common/ros/messages.py", "common/ros/session.py", "run/graph.py")
ONLY_IN = {  # library: the files that may import it
    **dict.fromkeys(ROS, WITH_ROS),
    "mcap": ("common/bags/*",),
    "rosbags": ("common/bags/*",),
    "pytetwild": ("fem_node/mesh/mesher.py",),
    "cv2": ("stereo_node/*", "synthetic/*"),
}
# what the closed loop knows of the model: effects and physics, meshes, and one simulator with derivatives
KNOWN_TO_THE_LOOP = {"declared", "effects", "mesh.generate", "mesh.tet_mesh", "physics.memory", "physics.record",
                     "refinement", "simulator"}  # fmt: skip
WITH_NODES = ("run/running.py", "run/playing.py", "demo.py")  # they run or feed the graph, and so import ROS
MODULES = sorted(SRC.glob("**/*.py"))


@cache
def imports(path: Path) -> set[str]:
    """Dotted names of all imports in a file, wherever they stand."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module)
    return names


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(SRC)))
def test_imports_go_to_a_lower_layer_or_stay(path: Path):
    package = path.relative_to(SRC).parts[0]
    for name in imports(path):
        words = name.split(".")
        if words[0] == "livedeform" and words[1:] and words[1] != package:
            here, there = LAYER.get(package, FACE), LAYER.get(words[1], FACE)
            assert there < here or here == there == FACE, f"{path.relative_to(SRC)} imports {name}"


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(SRC)))
def test_foreign_libraries_have_one_home(path: Path):
    where = str(path.relative_to(SRC))
    for name in imports(path):
        allowed = ONLY_IN.get(name.split(".")[0])
        assert allowed is None or any(fnmatch(where, p) for p in allowed), f"{where} imports {name}"


def test_the_closed_loop_asks_the_model_through_few_modules():
    """Another simulator, or another way to differentiate one, needs no change there."""
    assert len(KNOWN_TO_THE_LOOP) <= 8
    for path in SRC.glob("closed_loop/**/*.py"):
        for name in imports(path):
            package, _, module = name.partition("livedeform.fem_node.")
            assert package or module in KNOWN_TO_THE_LOOP, f"{path.relative_to(SRC)} imports {name}"


@pytest.mark.parametrize("name", ["stereo_node", "fem_node", "compare_node"])
def test_nodes_are_thin(name: str):
    lines = (SRC / name / "node.py").read_text().splitlines()
    assert len(lines) <= 120, f"{name}/node.py has {len(lines)} lines"


def test_pure_layers_import_without_ros():
    """rclpy set to None in a process of its own: everything that needs no ROS still imports."""
    missing = [] if find_spec("pyarrow") else ["campaign/*.py"]  # an extra
    pure = [
        ".".join(("livedeform", *p.relative_to(SRC).with_suffix("").parts)).removesuffix(".__init__")
        for p in MODULES
        if not any(fnmatch(str(p.relative_to(SRC)), pattern) for pattern in (*ONLY_IN["rclpy"], *WITH_NODES, *missing))
    ]
    code = "import sys\n" + "".join(f"sys.modules[{name!r}] = None\n" for name in ROS)
    code += "import importlib\n" + "".join(f"importlib.import_module({name!r})\n" for name in pure)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_the_truth_knows_nothing_of_the_model_that_it_judges():
    """What makes synthetic recordings shares no element, contact or solver with the model (no inverse crime)."""
    judged = ("livedeform.fem_node", "livedeform.closed_loop", "livedeform.compare_node")
    for path in SRC.glob("synthetic/**/*.py"):
        for name in imports(path):
            assert not name.startswith(judged), f"{path.relative_to(SRC)} imports {name}"
    modules = [
        ".".join(("livedeform", *p.relative_to(SRC).with_suffix("").parts)).removesuffix(".__init__")
        for p in SRC.glob("synthetic/**/*.py")
    ]
    code = f"import sys, importlib\nfor name in {modules!r}: importlib.import_module(name)\n"
    code += f"print([name for name in sys.modules if name.startswith({judged!r})])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


def test_nothing_but_the_command_line_prints_or_exits():
    """print and sys.exit belong to the CLI; a library raises or returns. What ends workers ends itself as well."""
    allowed = ("cli.py", "progress.py", "commands/*", "*/__main__.py", "*/node.py",
               "common/ros/session.py", "run/graph.py", "common/processes.py")  # fmt: skip
    for path in MODULES:
        where = str(path.relative_to(SRC))
        if any(fnmatch(where, p) for p in allowed):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                assert called not in ("print", "exit", "quit", "sys.exit", "os._exit"), (
                    f"{where}:{node.lineno} calls {called}"
                )


def test_no_bare_except():
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ExceptHandler):
                assert node.type is not None, f"{path.relative_to(SRC)}:{node.lineno} has a bare except"


# the rooms and files of fem_node that a room of it may import, besides itself and `common`
MAY_IMPORT = {
    "mesh": (),
    "physics": ("mesh",),
    "effects": ("physics",),
    "materials": ("element", "physics"),
    "element": ("materials", "mesh", "solve"),
    "solve": ("contact", "items"),
    "items": ("contact", "element", "materials", "physics", "solve"),
    "contact": ("element", "items", "mesh", "physics", "solve"),
    "path": ("contact", "element", "embedded_points", "items", "model", "physics", "solve"),
    "live": ("contact", "items", "mesh", "model", "path", "physics", "solve"),
}


def test_rooms_of_the_model_import_what_they_may():
    rooms = {p.name for p in (SRC / "fem_node").iterdir() if (p / "__init__.py").exists()}
    assert rooms == set(MAY_IMPORT)
    for room, others in MAY_IMPORT.items():
        for path in (SRC / "fem_node" / room).glob("*.py"):
            known = {name.split(".")[2] for name in imports(path) if name.startswith("livedeform.fem_node.")}
            more = known - {room, *others}
            assert not more, f"fem_node/{room}/{path.name} imports {', '.join(more)}"


# rooms of the closed loop: evidence, then inference on it, then the assessment of what was inferred; the model apart
NEVER = (("evidence", "inference"), ("evidence", "assessment"), ("evidence", "model"), ("inference", "assessment"),
         ("inference", "model"), ("assessment", "model"), ("model", "inference"), ("model", "assessment"))  # fmt: skip


def test_inference_and_the_model_know_each_other_by_one_interface():
    """Neither imports the other: only `closed_loop.forward` stands between."""
    for room, other in NEVER:
        for path in (SRC / "closed_loop" / room).glob("*.py"):
            known = {name for name in imports(path) if name.startswith(f"livedeform.closed_loop.{other}")}
            assert not known, f"closed_loop/{room}/{path.name} imports {', '.join(known)}"


PLAIN = {0, 1, 2, 3, 4, 0.5, 100, 1e3, 1e-3, 1e6, 1e-6, 1e9, 1e-9}  # counts of axes, halves, percent, SI prefixes


def _unplain(node: ast.AST) -> list[float]:
    """Numbers under a node but plain ones, docstrings' and indices' aside."""
    if isinstance(node, ast.Subscript):
        return _unplain(node.value)
    if isinstance(node, ast.Constant):
        is_number = isinstance(node.value, int | float) and not isinstance(node.value, bool)
        return [node.value] if is_number and node.value not in PLAIN else []
    return [number for child in ast.iter_child_nodes(node) for number in _unplain(child)]


def test_numbers_of_the_closed_loop_stand_in_its_settings():
    """Numbers in bodies of functions, as `benchmarks/house.py` counts them; what decides belongs into `Settings`."""
    inline = [
        f"{path.relative_to(SRC)}: {number}"
        for path in (SRC / "closed_loop").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
        for statement in node.body
        for number in _unplain(statement)
    ]
    assert len(inline) <= 25, inline  # measured 6


ONE_HOME = {  # what is defined or called once only, and where
    r"Slerp\(": {"common/frames.py"},
    r"(?m)^def rmse\(": {"compare_node/metrics.py"},
    r"(?m)^def p95\(": {"compare_node/metrics.py"},
    r"percentile\([^)]*95": {"compare_node/metrics.py"},
    r"def rig_of\(": {"stereo_node/camera/setup.py"},
    r"def declared_camera_pose\(": {"stereo_node/camera/setup.py"},
    r"latched=True": {"common/topics.py"},
    r"def memory_of\(": {"fem_node/physics/memory.py"},
    r"PUBLISHED: ": {"common/published_effects.py"},
}


@pytest.mark.parametrize("pattern", ONE_HOME)
def test_a_fact_has_one_home(pattern: str):
    found = {str(path.relative_to(SRC)) for path in MODULES if re.search(pattern, path.read_text())}
    assert found == ONE_HOME[pattern]


def test_metrics_of_a_comparison_have_one_home():
    """Nobody in the closed loop takes a mean square or a percentile of errors by itself."""
    for path in (SRC / "closed_loop").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                assert node.name not in ("p95", "percentile", "metrics_of", "_rmse"), f"{path}:{node.lineno}"
            if isinstance(node, ast.Attribute):
                assert node.attr != "percentile", f"{path}:{node.lineno}"


def test_neither_the_solver_nor_the_search_asks_for_an_effects_name():
    """What they must know of an effect stands on its card; a baseline, the modulus alone, is the one with a name."""
    from livedeform.common.effect import EFFECT_PARAMETERS

    allowed = {("closed_loop/loop.py", "stiffness"), ("fem_node/physics/memory.py", "inertia")}  # a baseline; a word
    rooms = [
        p for p in MODULES if p.relative_to(SRC).parts[0] in ("closed_loop", "fem_node") and "effects" not in p.parts
    ]
    for path in rooms:
        where = str(path.relative_to(SRC))
        words = {n.value for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Constant)}
        named = {(where, word) for word in words if isinstance(word, str) and word.split(".")[0] in EFFECT_PARAMETERS}
        assert named <= allowed, f"{named - allowed}: put what is asked for on the effect's card"
