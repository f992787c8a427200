"""The README and the docs say what is there: commands and options exist, links lead somewhere, examples run."""

from __future__ import annotations

import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import typer
import yaml

from livedeform.cli import app

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
CODE = ("src", "tests", "benchmarks", "docs", "examples", "setup.py", "launch")
EXAMPLES = [*sorted((ROOT / "examples").glob("[0-9]*.py")), *sorted((ROOT / "examples" / "notebooks").glob("*.py"))]


@cache
def commands() -> dict[tuple[str, ...], set[str]]:
    """Command words -> options, of the whole program."""

    def walk(command: object, words: tuple[str, ...]) -> dict[tuple[str, ...], set[str]]:
        options = {o for p in command.params for o in (*p.opts, *p.secondary_opts) if o.startswith("-")}  # type: ignore[attr-defined]
        out = {words: options | {"--help", "-h", "--debug"}}
        for name, sub in getattr(command, "commands", {}).items():
            out |= walk(sub, (*words, name))
        return out

    return walk(typer.main.get_command(app), ())


def said(page: Path) -> list[str]:
    """Every `livedeform ...` command line that a page shows, in code blocks and in backticks."""
    text = page.read_text()
    lines = re.findall(r"^(?:\$ |    )(livedeform .*)$", text, re.M) + re.findall(r"`(livedeform [^`]+)`", text)
    return [line.split("#")[0].strip() for line in lines]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_commands_and_options_exist(page: Path) -> None:
    for line in said(page):
        words = line.replace("[", " ").replace("]", " ").split()[1:]
        path: tuple[str, ...] = ()
        for word in words:
            if (*path, word) not in commands():
                break
            path = (*path, word)
        assert path or words[0].startswith("-"), f"{page.name}: no such command in '{line}'"
        for option in re.findall(r"(?<![\w-])(--?[a-z][\w-]*)", " ".join(words[len(path) :])):
            assert option in commands()[path], f"{page.name}: '{line}' has no option {option}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
        if not target.startswith(("http://", "https://")):
            assert (page.parent / target).exists(), f"{page.name}: {target} is not there"


@pytest.mark.parametrize("target", ["demo", "test"])
def test_the_two_commands_are_targets_of_make(target: str) -> None:
    assert f"$ make {target}" in (ROOT / "README.md").read_text()
    done = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_effects_page_is_what_the_catalogue_says() -> None:
    done = subprocess.run([sys.executable, "docs/make_effects.py", "--check"], cwd=ROOT, check=False)
    assert done.returncode == 0, "run: python docs/make_effects.py"


def test_the_items_page_is_what_the_docstrings_say() -> None:
    done = subprocess.run([sys.executable, "docs/make_items.py", "--check"], cwd=ROOT, check=False)
    assert done.returncode == 0, "run: python docs/make_items.py"


def test_the_documented_experiment_is_valid_yaml_with_known_keys() -> None:
    from livedeform.common.experiment.yaml_file import json_schema

    text = re.search(r"```yaml\n(.*?)```", (ROOT / "docs" / "experiment.md").read_text(), re.S)
    assert text is not None
    document = yaml.safe_load(text.group(1))
    assert set(document) <= set(json_schema()["properties"])


def test_every_study_is_documented() -> None:
    from livedeform.studies import STUDIES

    page = (ROOT / "docs" / "studies.md").read_text()
    for name in STUDIES:
        assert f"| `{name}` |" in page


def test_citation_is_readable() -> None:
    document = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "title", "authors", "license"} <= set(document)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda p: p.name)
def test_examples_run(example: Path, tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, str(example)], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


SOURCES = {str(p.relative_to(ROOT)) for p in ROOT.rglob("*.py") if p.relative_to(ROOT).parts[0] in CODE}


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=lambda p: p.name)
def test_modules_that_a_page_names_exist(page: Path) -> None:
    """A path may be the end of one (`path/walk.py`), or dotted (`livedeform.fem_node.mesh`, with a name in it)."""
    text = page.read_text()
    for path in re.findall(r"(?<![\w/.*<-])((?:[\w-]+/)*[a-z_][\w.]*\.py)\b", text):
        assert any(known == path or known.endswith(f"/{path}") for known in SOURCES), f"{page.name}: no file {path}"
    for dotted in re.findall(r"\b((?:livedeform|benchmarks)(?:\.[A-Za-z_]\w*)+)", text):
        known = dotted.endswith(".py") or _file_of(dotted.split(".")) is not None
        assert known, f"{page.name}: no module {dotted}"


def _file_of(names: list[str]) -> Path | None:
    """The file of a module, or of a module with a name that stands in it."""
    base = ROOT / "src" if names[0] == "livedeform" else ROOT
    for module, inside in ((names, ""), (names[:-1], names[-1])):
        for file in (base.joinpath(*module).with_suffix(".py"), base.joinpath(*module, "__init__.py")):
            if file.is_file() and inside in file.read_text():
                return file
    return None


@pytest.mark.parametrize("notebook", sorted((ROOT / "examples" / "notebooks").glob("*.py")), ids=lambda p: p.name)
def test_notebooks_are_notebooks(notebook: Path) -> None:
    """Jupytext's percent format: prose and code take turns, and prose comes first."""
    cells = re.split(r"^# %%", notebook.read_text(), flags=re.M)[1:]
    kinds = ["prose" if cell.startswith(" [markdown]") else "code" for cell in cells]
    assert kinds[0] == "prose" and kinds.count("code") >= 4 and kinds.count("prose") >= kinds.count("code")
    jupytext = pytest.importorskip("jupytext")
    made = jupytext.read(notebook)
    assert [cell["cell_type"] for cell in made["cells"]] == [{"prose": "markdown"}.get(k, k) for k in kinds]
