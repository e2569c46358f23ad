"""Imports: the library knows no Slicer, loads nothing heavy before it is used, and its stages do not point backwards."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LIBRARY = ROOT / "MedColorLib"
FILES = sorted(LIBRARY.rglob("*.py"))
HEAVY = (
    "torch",
    "cv2",
    "vtk",
    "vtkmodules",
    "scipy",
    "SimpleITK",
    "pydicom",
    "tifffile",
    "nibabel",
    "nrrd",
    "safetensors",
    "matplotlib",
    "tqdm",
    "distributed",
)
WITHOUT_EXIT = "import contextlib\nfrom MedColorLib.cli.main import main\nwith contextlib.suppress(SystemExit):"
HOSTS = {"slicer", "qt", "ctk", "vtkSlicer", "mrml", "PySide6", "MedColor", "MedColorSlicer"}


def module_of(path: Path) -> str:
    """Dotted name below MedColorLib: 'features.weights', '' for the package itself."""
    parts = path.relative_to(LIBRARY).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def exists(module: str) -> bool:
    path = LIBRARY.joinpath(*module.split("."))
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"


def statements(tree: ast.AST):
    """All nodes but those that only type checkers see."""
    for node in ast.iter_child_nodes(tree):
        if not is_type_checking(node):
            yield node
            yield from statements(node)


def imports(path: Path):
    """(absolute names from outside, modules of the library) that a file imports anywhere."""
    outside, inside = set(), set()
    package = module_of(path).split(".") if path.name == "__init__.py" else module_of(path).split(".")[:-1]
    package = [part for part in package if part]
    for node in statements(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            outside |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            outside.add(node.module)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] + (node.module.split(".") if node.module else [])
            for alias in node.names:
                full = ".".join([*base, alias.name])
                inside.add(full if exists(full) else ".".join(base))
    return outside, inside


GRAPH = {module_of(path): imports(path) for path in FILES}


def in_fresh_python(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
        env={"PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(LIBRARY)))
def test_no_host_application(path):
    names = {name.split(".")[0] for name in GRAPH[module_of(path)][0]}
    assert not names & HOSTS
    assert "MedColorLib" not in names, "inside the library imports are relative"


@pytest.mark.parametrize(
    "work",
    [
        "import MedColorLib; dir(MedColorLib)",
        "from MedColorLib import Settings, Volume, Plan, colorize, make_plan",
        "from MedColorLib import read_volume, write_color_volume, fast_global_smoother",
        "from MedColorLib.cli.options import make_parser; make_parser().format_help()",
        f"{WITHOUT_EXIT} main(['colorize', '--help'])",
        f"{WITHOUT_EXIT} main(['--version'])",
    ],
)
def test_nothing_heavy_is_loaded(work):
    code = f"import sys\n{work}\nprint('LOADED', *[name for name in {HEAVY} if name in sys.modules])"
    assert in_fresh_python(code).splitlines()[-1] == "LOADED"


def test_python_minus_m_help_loads_nothing_heavy():
    code = (
        "import atexit, runpy, sys\nsys.argv = ['medcolor', '--help']\n"
        f"atexit.register(lambda: print('LOADED', *[name for name in {HEAVY} if name in sys.modules]))\n"
        "runpy.run_module('MedColorLib', run_name='__main__')"
    )
    lines = in_fresh_python(code).splitlines()
    assert lines[0].startswith("usage: medcolor") and lines[-1] == "LOADED"


def test_a_plan_of_bad_input_does_not_load_torch():
    """Torch itself is left out where the input is refused before any computing."""
    code = (
        "import sys, numpy as np\nfrom MedColorLib import Volume, make_plan\n"
        "try: make_plan(Volume(np.zeros((2, 2, 2))), [])\n"
        "except Exception as error: print(type(error).__name__)\nprint('torch' in sys.modules)"
    )
    assert in_fresh_python(code).split() == ["InputError", "False"]


def test_no_arrow_runs_back_up():
    """The layers and the ban on circles are contracts of import-linter in pyproject.toml."""
    linter = Path(sys.executable).with_name("lint-imports")
    if not linter.exists() and sys.version_info < (3, 10):
        pytest.skip("import-linter 2.6, which knows acyclic siblings, needs Python 3.10")
    done = subprocess.run([linter, "--no-cache"], capture_output=True, encoding="utf-8", cwd=ROOT, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_public_names_exist():
    import MedColorLib

    for name in MedColorLib.__all__:
        assert getattr(MedColorLib, name) is not None and name in dir(MedColorLib)
    with pytest.raises(AttributeError, match="has no attribute 'colourise'"):
        _ = MedColorLib.colourise
