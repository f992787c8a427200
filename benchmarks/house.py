"""Measure the layout of the code: sizes, rooms, numbers that decide, predicates of memory, types, names, words.

    python -m benchmarks.house [--src DIR] [--list FIGURE] [--no-types]

prints one line per figure with its target; ``--list FIGURE`` names what was counted. ``--src`` is the folder with the
packages: one package ``livedeform`` with rooms, or several packages side by side, as it was before. What is counted
is said in the docstring of each function below; where it is a heuristic, that says so.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

SRC = Path(__file__).parents[1] / "src"
LONG = 40  # lines
REGISTRIES = {"effects", "commands"}  # folders of which every file is an entry
# plain numbers: counts of axes and halves, percent, SI prefixes; anything else in a function body is an inline number
PLAIN = {0, 1, 2, 3, 4, 0.5, 100, 1e3, 1e-3, 1e6, 1e-6, 1e9, 1e-9}
# what of the physics makes an answer depend on more than the pose
MEMORY_WORDS = {"prony", "plastic_set", "inertia", "swelling", "friction", "adhesion", "rubs", "sticks", "strength",
                "interfaces", "modulus_fields", "release", "viscous"}  # fmt: skip
ASKED = r"(\bmemory|\bmemory_of\(.*\)|\bINFO|\binfo)$"  # the record of memory, and an effect's card
NOT_OF_MEMORY = {
    "fem_node/contact/contact.py settle": "an outer iteration by the law; True while it still moves",
    "fem_node/contact/contact.py let_go": "the same, of what is stretched too far; True while anything lets go",
    "fem_node/items/continuum.py update": "an outer iteration by the law; True while it still moves",
    "fem_node/path/tangents.py answers_linearly": "the tangents follow no multipliers of a second body, bonded or not",
}
# constants of closed_loop that stand beside the code that they belong to, as no other value would be as good; what is
# not named here decides
OF_ONE_FUNCTION = {
    "by definition": {
        "DIFFERENCES", "MAD_PER_SIGMA", "SIGMA_PER_MAD", "MEDIAN_CHI2_3",  # of a normal distribution
        "MEDIAN_OVER_MEAN",  # of a normal distribution
        "LEVEL", "LEVELS", "DRAWS", "Z95",  # an interval of 95 %, and its bootstrap
        "LEAST_MARKERS", "LEAST_MOMENTS",  # one more than place a rigid body; before and in a press
        "MOTION", "PER_UNIT", "TRANSFORMS",  # lengths of vectors, and what a unit stands for
        "RELIABILITY",  # that of a published method, beside which ours is shown
        "FIELDS", "PIXEL",  # coefficients of a linear field; what a setting is a twentieth of
    },
    "guards against zero and round-off": {
        "FLAT", "LEAST_OF_A_LINE", "LEAST_SIGMA", "NEARLY_NOTHING", "NOTHING", "ON_BOUND", "RANK", "RATES", "SEEN",
        "SINGLE", "SOME_MOTION", "SOONER", "STILL", "TINY", "TINY_VARIANCE",
    },
    "steps of differences": {"AMPLITUDE_STEPS", "CLOCK_STEP", "DIFFERENCE", "SECANT_STEP", "STEP", "TURNS", "WALK"},
    "sharing of work": {
        "BEGINS_TO_RUB", "ENOUGH", "MANY", "OWN_RUN", "PULLING", "PULLING_AND_RUBBING", "SWINGS", "TOLD_EVERY",
    },
    "what is kept": {"LARGEST"},
}  # fmt: skip
FIRST_WORDS_OF_FRAGMENTS = {
    "of", "from", "as", "at", "in", "by", "with", "what", "which", "that", "whose", "whether", "how", "where", "when",
    "why", "for", "to", "on", "and", "per", "its", "like", "until", "after", "before", "between", "so",
}  # fmt: skip


@dataclass(frozen=True)
class Figure:
    """One figure: its ``value`` as text, the target, and what was counted."""

    name: str
    value: str
    target: str
    counted: Sequence[str] = ()


class Tree:
    """The parsed files under a folder, told apart by room (``closed_loop``, ``fem_node``, ...) in either layout."""

    def __init__(self, src: Path) -> None:
        self.src = src.resolve()
        self.files = sorted(p for p in self.src.rglob("*.py") if ".egg-info" not in str(p))
        self.lines = {p: p.read_text().count("\n") for p in self.files}
        self.parsed = {p: ast.parse(p.read_text()) for p in self.files}

    def name(self, path: Path) -> str:
        """The path from the package on, without ``livedeform/`` where that holds everything."""
        parts = path.relative_to(self.src).parts
        return "/".join(parts[1:] if self.one_package else parts)

    @cached_property
    def one_package(self) -> bool:
        """Whether the nodes are rooms of one package."""
        return (self.src / "livedeform" / "fem_node").is_dir()

    def within(self, room: str) -> list[Path]:
        """The files of a room."""
        return [p for p in self.files if self.name(p).startswith(f"{room}/")]

    def functions(self) -> Iterator[tuple[Path, ast.FunctionDef | ast.AsyncFunctionDef]]:
        """Yield every function that is no numba kernel and does not lie in one."""
        for path, tree in self.parsed.items():
            for node in _without_kernels(tree):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    yield path, node


def _without_kernels(node: ast.AST) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        if not _is_kernel(child):
            yield child
            yield from _without_kernels(child)


def _is_kernel(node: ast.AST) -> bool:
    decorators = getattr(node, "decorator_list", [])
    return any(re.search(r"njit|vectorize|intrinsic|overload", ast.unparse(d)) for d in decorators)


def function_lengths(tree: Tree) -> list[Figure]:
    """Lines from ``def`` to the last line, docstring included, kernels left out."""
    lengths = []
    for path, node in tree.functions():
        lengths.append(((node.end_lineno or 0) - node.lineno + 1, f"{tree.name(path)}:{node.lineno} {node.name}"))
    long = sorted((x for x in lengths if x[0] > LONG), reverse=True)
    rows = [f"{n} {where}" for n, where in long]
    return [
        Figure("longest function outside kernels", f"{max(lengths)[0]} lines", "<= 50", rows[:1]),
        Figure(f"functions over {LONG} lines", f"{len(long)}", "<= 15", rows),
    ]


def rooms(tree: Tree) -> list[Figure]:
    """Files that lie flat in a folder, ``__init__`` aside; registries are left out."""
    flat = Counter(p.parent for p in tree.files if p.name != "__init__.py" and p.parent.name not in REGISTRIES)
    rows = [f"{n} {folder.relative_to(tree.src)}" for folder, n in flat.most_common() if n > 12]
    largest, n = flat.most_common(1)[0]
    value = f"{n} ({largest.relative_to(tree.src)}); {len(rows)} rooms over 12"
    return [Figure("files flat in the fullest room", value, "<= 12", rows)]


def thresholds(tree: Tree) -> list[Figure]:
    """Numbers of ``closed_loop`` that decide a verdict or size an allowance, and all that have a name.

    Those that decide are the fields of the records in ``settings.py`` made by ``_decides`` or ``_allows`` (as
    `n_deciding` counts them; in a tree without roles all its fields), and the upper-case numbers at the top of other
    files that ``OF_ONE_FUNCTION`` does not name.
    """
    fields, others, excused = [], [], Counter[str]()
    all_fields = 0
    kinds = {name: kind for kind, names in OF_ONE_FUNCTION.items() for name in names}
    for path in tree.within("closed_loop"):
        if tree.name(path) == "closed_loop/settings.py":
            classes = [n for n in tree.parsed[path].body if isinstance(n, ast.ClassDef)]
            numbers = [(c.name, s) for c in classes for s in c.body if _is_number_field(s)]
            all_fields, roles = len(numbers), "_decides" in path.read_text()
            fields = [f"{name}.{ast.unparse(s.target)}" for name, s in numbers if not roles or _has_role(s)]  # type: ignore[attr-defined]
            continue
        for name in _constants(tree.parsed[path]):
            if name in kinds:
                excused[kinds[name]] += 1
            else:
                others.append(f"{tree.name(path)} {name}")
    files = len({row.split()[0] for row in others})
    value = f"{len(fields)} in 1 record, {len(others)} in {files} other files"
    beside = ", ".join(f"{n} {kind}" for kind, n in sorted(excused.items()))
    return [
        Figure("numbers that decide", value, "<= 45 in 1 file", [*fields, *others]),
        Figure("other numbers of closed_loop with a name", f"{all_fields - len(fields)} of effort in the record", ""),
        Figure("", beside, ""),
    ]


def _has_role(field: ast.stmt) -> bool:
    """Tell whether a field of the settings decides or allows."""
    return bool(re.match(r"_(decides|allows)\(", ast.unparse(getattr(field, "value", None) or ast.Constant(0))))


def _is_number_field(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.AnnAssign) and bool(re.search(r"float|int", ast.unparse(statement.annotation)))


def _constants(module: ast.Module) -> list[str]:
    """Upper-case names at the top of a module that hold numbers, or tuples or tables of them."""
    names = []
    for statement in module.body:
        targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
        value = getattr(statement, "value", None)
        flat = [t for target in targets for t in (target.elts if isinstance(target, ast.Tuple) else [target])]
        for target in flat:
            if isinstance(target, ast.Name) and target.id.lstrip("_").isupper() and _numbers(value):
                names.append(target.id)
    return names


def _numbers(node: ast.AST | None) -> list[float]:
    return [n.value for n in ast.walk(node) if _is_number(n)] if node is not None else []  # type: ignore[attr-defined]


def _is_number(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool)


def inline_numbers(tree: Tree) -> list[Figure]:
    """Numbers in function bodies of closed_loop other than ``PLAIN`` and those in indices (a heuristic)."""
    rows = []
    inside = set(tree.within("closed_loop"))
    for path, function in tree.functions():
        if path in inside:
            rows += [f"{tree.name(path)}:{n.lineno} {n.value}" for n in _unplain(function)]
    rows = sorted(set(rows))
    return [Figure("inline numbers in closed_loop", str(len(rows)), "<= 25", rows)]


def _unplain(function: ast.AST) -> Iterator[ast.Constant]:
    for node in ast.iter_child_nodes(function):
        if isinstance(node, ast.Subscript):  # an index is no decision
            yield from _unplain(node.value)
        elif isinstance(node, ast.Constant) and _is_number(node):
            if node.value not in PLAIN:
                yield node
        else:
            yield from _unplain(node)


def memory(tree: Tree) -> list[Figure]:
    """Functions that answer yes or no from what the physics remembers, outside of the one home (a heuristic).

    Counted is a function ``-> bool``, or named ``why_...``, whose body reads one of ``MEMORY_WORDS`` as an attribute,
    or the name of a type. Not counted is what it reads off the record itself or off an effect's card, nor are those of
    ``NOT_OF_MEMORY``, which read the words to another end.
    """
    rows = []
    for path, node in tree.functions():
        if not re.match("(fem_node|closed_loop)/", tree.name(path)) or path.name == "memory.py":
            continue
        answers = node.returns is not None and ast.unparse(node.returns) == "bool"
        attributes = [n for n in ast.walk(node) if isinstance(n, ast.Attribute)]
        read = {n.attr for n in attributes if not re.search(ASKED, ast.unparse(n.value))}
        read &= MEMORY_WORDS | {"__name__"}
        if f"{tree.name(path)} {node.name}" in NOT_OF_MEMORY:
            continue
        if read and (answers or node.name.startswith("why_")):
            rows.append(f"{tree.name(path)}:{node.lineno} {node.name} ({', '.join(sorted(read))})")
    value = f"{len(rows)} outside of physics/memory.py"
    return [Figure("predicates of memory", value, "0 outside of 1 home", rows)]


def knowledge(tree: Tree) -> list[Figure]:
    """Modules of fem_node that closed_loop imports; a name imported from a package counts as the package's."""
    seen = set()
    for path in tree.within("closed_loop"):
        for node in ast.walk(tree.parsed[path]):
            if isinstance(node, ast.ImportFrom) and node.module:
                modules = {node.module} | {f"{node.module}.{a.name}" for a in node.names}
            elif isinstance(node, ast.Import):
                modules = {a.name for a in node.names}
            else:
                continue
            seen |= {m for m in modules if re.match(r"(livedeform\.)?fem_node(\.|$)", m) and _is_module(tree, m)}
    return [Figure("modules of fem_node that closed_loop imports", str(len(seen)), "<= 8", sorted(seen))]


def _is_module(tree: Tree, dotted: str) -> bool:
    return (tree.src / f"{dotted.replace('.', '/')}.py").exists()


def names_used_twice(tree: Tree) -> list[Figure]:
    """Names of classes that two or more places define, private ones included."""
    places = defaultdict(list)
    for path, parsed in tree.parsed.items():
        for node in ast.walk(parsed):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(tree.name(path))
    rows = [f"{name}: {', '.join(where)}" for name, where in sorted(places.items()) if len(where) > 1]
    return [Figure("class names used twice", str(len(rows)), "<= 8", rows)]


def size(tree: Tree) -> list[Figure]:
    """Lines of all files, blank ones and comments included."""
    return [Figure("src lines", f"{sum(tree.lines.values())} in {len(tree.files)} files", "less than 39.3k")]


def fragments(tree: Tree) -> list[Figure]:
    """Docstrings whose first word cannot begin a sentence, questions aside (a heuristic), private ones included."""
    rows, n = [], 0
    for path, parsed in tree.parsed.items():
        for node in ast.walk(parsed):
            if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            text = ast.get_docstring(node)
            if not text:
                continue
            n += 1
            word = re.split(r"[^A-Za-z]", text, maxsplit=1)[0].lower()
            asks = text.splitlines()[0].endswith("?")
            if word in FIRST_WORDS_OF_FRAGMENTS and not asks:
                line = getattr(node, "lineno", 1)
                rows.append(f"{tree.name(path)}:{line} {text.splitlines()[0][:70]}")
    return [Figure("docstrings that begin with a fragment", f"{len(rows)} of {n}", "0", rows)]


def strict_types(tree: Tree) -> list[Figure]:
    """Errors of ``mypy --strict``, those in files with numba kernels left out."""
    command = [sys.executable, "-m", "mypy", "--strict", "--ignore-missing-imports", "--no-error-summary"]
    command += [
        "--config-file",
        os.devnull,
        "--cache-dir",
        os.devnull,
        "--python-version",
        "3.11",
        "--disable-error-code=import-untyped",
    ]
    command += [f"--untyped-calls-exclude={library}" for library in ("rclpy", "mcap", "rosbags", "trimesh")]  # not ours
    packages = sorted(p.parent.name for p in tree.src.glob("*/__init__.py"))
    done = subprocess.run(
        [*command, *(word for p in packages for word in ("-p", p))], cwd=tree.src, capture_output=True, text=True
    )
    if done.returncode not in (0, 1):
        return [Figure("mypy --strict errors", "mypy did not run", "0", (done.stdout + done.stderr).splitlines())]
    kernels = {str(p.relative_to(tree.src)) for p in tree.files if re.search(r"@(numba\.)?njit", p.read_text())}
    rows = [line for line in done.stdout.splitlines() if ": error:" in line and line.split(":")[0] not in kernels]
    rooms = Counter("/".join(row.split(":")[0].split("/")[: 2 if tree.one_package else 1]) for row in rows)
    value = f"{len(rows)}" + (f" ({', '.join(f'{n} {room}' for room, n in rooms.most_common(4))})" if rows else "")
    return [Figure("mypy --strict errors outside of kernels", value, "0", rows)]


FIGURES: tuple[Callable[[Tree], list[Figure]], ...] = (
    function_lengths, rooms, thresholds, inline_numbers, memory, knowledge, strict_types, names_used_twice, size,
    fragments,
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the figures; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--src", type=Path, default=SRC, help="folder with the packages")
    parser.add_argument("--list", default=None, metavar="FIGURE", help="names what was counted: a part of its name")
    parser.add_argument("--no-types", action="store_true", help="without mypy, which takes half a minute")
    options = parser.parse_args(arguments)
    tree = Tree(options.src)
    for measure in FIGURES:
        if measure is strict_types and options.no_types:
            continue
        for figure in measure(tree):
            print(f"{figure.name:46s} {figure.value:70s} {figure.target}")
            if options.list is not None and options.list in figure.name:
                print("".join(f"    {row}\n" for row in figure.counted), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
