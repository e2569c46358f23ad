"""Documentation: what is public is described, examples run, and files, commands and options that are named exist."""

from __future__ import annotations

import ast
import doctest
import importlib.util
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from volume_samples import LPS, save_nrrd

import MedColorLib
from MedColorLib.cli.options import make_parser
from MedColorLib.cli.options_page import all_options, options_page

ROOT = Path(__file__).resolve().parents[2]
LIBRARY = ROOT / "MedColorLib"
FILES = sorted(LIBRARY.rglob("*.py"))
DOCUMENTATION = ROOT / "Resources" / "Documentation"
PAGES = [ROOT / "README.md", *sorted(DOCUMENTATION.glob("*.md")), *sorted((ROOT / "Testing").glob("*/README.md"))]
OTHERS_OPTIONS = {"--no-main-window", "--no-splash", "--python-script", "--python-code", "--testing"}  # of Slicer
WITH_EXAMPLES = [path for path in FILES if ">>> " in path.read_text(encoding="utf-8")]


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


def public(tree: ast.AST, prefix: str = ""):
    """(name, node) of public functions, classes and their methods; overrides of a described protocol count as well."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from public(node, f"{prefix}{node.name}.")


@pytest.mark.parametrize("path", FILES, ids=relative)
def test_public_names_have_docstrings(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    bare = [name for name, node in public(tree) if not ast.get_docstring(node)]
    if relative(path) == "MedColorLib/progress.py":
        bare = [name for name in bare if name not in ("Run.step", "Run.timed")]
    assert ast.get_docstring(tree) and not bare


@pytest.mark.parametrize("path", FILES, ids=relative)
def test_public_functions_have_type_hints(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    bare = []
    for name, node in public(tree):
        if isinstance(node, ast.FunctionDef) and "." not in name:
            arguments = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
            if arguments and not any(a.annotation for a in arguments) and node.returns is None:
                bare.append(name)
    assert not bare


@pytest.mark.parametrize("path", WITH_EXAMPLES, ids=relative)
def test_examples(path):
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    module = importlib.import_module(name)
    result = doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted > 0 and result.failed == 0


def test_the_package_itself_has_an_example():
    assert LIBRARY / "__init__.py" in WITH_EXAMPLES


def test_files_of_the_map_exist():
    rows = [line for line in MedColorLib.__doc__.splitlines() if line.startswith("| ")][2:]
    named = [name for row in rows for name in re.findall(r"`([\w/]+)`", row.split("|")[2])]
    assert len(named) > 15
    for name in named:
        path = LIBRARY / name
        assert path.is_dir() if name.endswith("/") else path.with_suffix(".py").is_file(), name


def test_no_machine_of_ours_in_the_sources():
    for path in [*FILES, *(ROOT / "Testing").rglob("*.py")]:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"(?<![\w.])/(?:work|home|root|Users)/\w", text), path


def words_of_commands(text: str):
    """The words after `medcolor` of every such line in a block of code."""
    for block in re.findall(r"```(?:sh)?\n(.*?)```", text, re.S):
        for line in block.replace("\\\n", " ").splitlines():
            words = line.split("#")[0].strip().lstrip("$ ")
            if re.match(r"(\.venv/bin/)?medcolor ", words):
                yield shlex.split(words)[1:]
    for words in re.findall(r"`medcolor ([^`]+)`", text):  # in a sentence; names in capitals and dots stand for more
        if not re.search(r"\.\.\.|(?<![\w:=-])[A-Z]{3,}\b", words):
            yield shlex.split(words)


def anchors(path: Path) -> set[str]:
    """How links name the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def code_blocks(path: Path, language: str) -> list[str]:
    """The blocks of code in that language."""
    return re.findall(rf"```{language}\n(.*?)```", path.read_text(encoding="utf-8"), re.S)


@pytest.mark.parametrize("page", PAGES, ids=relative)
class TestPages:
    def test_commands_are_accepted(self, page, capsys):
        for words in words_of_commands(page.read_text(encoding="utf-8")):
            try:
                make_parser().parse_args(words)
            except SystemExit as end:
                told = capsys.readouterr().err
                # a command that is only named, such as `medcolor render`, lacks what it works on
                named = all(re.fullmatch("[a-z]+", word) for word in words) and "required" in told
                assert end.code == 0 or named, f"medcolor {' '.join(words)}: {told}"

    def test_options_in_the_text_exist(self, page):
        named = set(re.findall(r"`(--[a-z][a-z0-9-]*)", page.read_text(encoding="utf-8")))
        assert named <= all_options() | OTHERS_OPTIONS

    def test_links_lead_somewhere(self, page):
        for target, anchor in re.findall(r"\]\(([^)#\s]*)#?([^)\s]*)\)", page.read_text(encoding="utf-8")):
            if re.match(r"[a-z]+:", target):
                continue
            file = (page.parent / target).resolve() if target else page
            assert file.exists(), target
            assert file.is_relative_to(ROOT), target
            assert not anchor or anchor in anchors(file), f"{target}#{anchor}"

    def test_files_and_modules_that_are_named_exist(self, page):
        text = page.read_text(encoding="utf-8")
        named = re.findall(r"(?<![\w./$-])(?:MedColorLib|MedColor|Testing|Resources)/[\w./-]*\w", text)
        missing = [name for name in named if not (ROOT / name).exists() and not re.search(r"[A-Z]{4}", name)]
        assert not missing
        for module in re.findall(r"-m (MedColorLib[\w.]*)", text):
            assert importlib.util.find_spec(module), module

    def test_python_examples_name_what_exists(self, page):
        for block in code_blocks(page, "python"):
            for node in ast.walk(ast.parse(block)):
                if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "MedColorLib":
                    module = importlib.import_module(node.module)
                    assert all(hasattr(module, alias.name) for alias in node.names), ast.unparse(node)

    def test_no_machine_of_ours(self, page):
        assert not re.search(r"(?<![\w.])/(?:work|home|root|Users)/\w", page.read_text(encoding="utf-8"))


class TestReadme:
    text = (ROOT / "README.md").read_text(encoding="utf-8")

    def test_has_commands(self):
        assert len(list(words_of_commands(self.text))) > 5

    def test_is_short(self):
        assert len(self.text.split()) <= 900

    def test_says_things_in_this_order(self):
        headings = re.findall(r"^## (.*)$", self.text, re.M)
        wanted = ["Try it: two commands", "In 3D Slicer", "From a shell", "From Python", "What to expect", "Cite"]
        assert headings[: len(wanted)] == wanted and headings[-1].endswith("licence")

    def test_every_page_is_reached_from_here(self):
        pages = {path.name for path in DOCUMENTATION.glob("*.md")}
        assert pages <= set(re.findall(r"Resources/Documentation/([\w-]+\.md)", self.text))

    def test_example(self, ct, tmp_path, monkeypatch):
        """The example runs, on the sample's files."""
        from MedColorLib.phantom import sample
        from MedColorLib.rendering.sheet import write_png

        monkeypatch.chdir(tmp_path)
        save_nrrd(Path("scan.nrrd"), ct.volume.array[4:7], LPS @ np.diag([2.0, 2.0, 2.0, 1.0]))
        write_png(Path("cryosection.png"), sample()[1])
        (block,) = code_blocks(ROOT / "README.md", "python")
        names: dict = {}
        exec(block, names)
        assert names["colored"].rgb.any() and Path("colored.nrrd").is_file()


@pytest.mark.parametrize("page", [ROOT / "README.md", DOCUMENTATION / "tutorial.md"], ids=relative)
def test_buttons_are_called_as_in_the_panel(page):
    module = ROOT / "MedColor"
    panel = "".join(path.read_text(encoding="utf-8") for path in [*module.rglob("*.ui"), *module.rglob("*.py")])
    clicks = page.read_text(encoding="utf-8").partition("From a shell" if page.name == "README.md" else "## A chest")[0]
    named = set(re.findall(r"(?<!^)\*\*([A-Z][\w -]+?)\*\*", clicks.partition("Slicer\n")[2]))
    named -= {"Five clicks", "Install", "MedColor"}
    assert {"Preview slice", "Compare with grey"} <= named
    assert not [name for name in named if name not in panel]


def test_the_page_of_options_is_what_the_parser_says():
    assert (DOCUMENTATION / "options.md").read_text(encoding="utf-8") == options_page(), (
        "run: python -m MedColorLib.cli.options_page Resources/Documentation/options.md"
    )


def test_every_option_is_explained():
    bare = [line for line in options_page().splitlines() if re.match(r"\| `[^|]*\|\s*\|", line)]
    assert not bare


def test_what_troubleshooting_says_is_said_by_the_program():
    sources = "".join(path.read_text(encoding="utf-8") for path in FILES)
    page = (DOCUMENTATION / "troubleshooting.md").read_text(encoding="utf-8")
    said = [
        text for row in re.findall(r"^\| `([^|]+)\|", page, re.M) for text in re.findall(r"`?([a-zA-Z][^`]*)`", row)
    ]
    assert len(said) > 5
    assert not [text for text in said if text not in sources]
