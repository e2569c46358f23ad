"""Documentation: what is public is described, examples run, and files, commands and options that are named exist."""

from __future__ import annotations

import ast
import doctest
import importlib
import re
import shlex
from pathlib import Path

import pytest

import MedColorLib
from MedColorLib.cli.options import make_parser

ROOT = Path(__file__).resolve().parents[2]
LIBRARY = ROOT / "MedColorLib"
FILES = sorted(LIBRARY.rglob("*.py"))
SLICERS_OWN = {"--no-main-window", "--no-splash", "--python-script", "--python-code", "--testing"}
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


class TestReadme:
    text = (ROOT / "README.md").read_text(encoding="utf-8")

    def commands(self):
        for block in re.findall(r"```[a-z]*\n(.*?)```", self.text, re.S):
            for line in block.replace("\\\n", " ").splitlines():
                words = line.split("#")[0].strip().lstrip("$ ")
                if re.match(r"(\.venv/bin/)?medcolor ", words):
                    yield shlex.split(words)[1:]

    def test_commands_are_accepted(self, capsys):
        commands = list(self.commands())
        assert commands
        for words in commands:
            try:
                make_parser().parse_args(words)
            except SystemExit as end:
                assert end.code == 0, f"medcolor {' '.join(words)}: {capsys.readouterr().err}"

    def test_options_in_the_text_exist(self, capsys):
        known = set()
        names = ("colorize", "batch", "render", "recommend", "library", "weights", "demo", "bench")
        for command in ((), *((name,) for name in names)):
            with pytest.raises(SystemExit):
                make_parser().parse_args([*command, "--help"])
            known |= set(re.findall(r"--[a-z][a-z0-9-]*", capsys.readouterr().out))
        named = set(re.findall(r"`(--[a-z][a-z0-9-]*)", self.text))
        assert named <= known | SLICERS_OWN

    def test_links_lead_somewhere(self):
        for target in re.findall(r"\]\(([^)#\s]+)", self.text):
            if not re.match(r"[a-z]+:", target):
                assert (ROOT / target).exists(), target
