"""The structure of the code: which package imports which, documented names, and what starts without torch."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
DEVELOPERS = ROOT / "docs" / "dev"
OURS = {"loops", "flow", "nlm", "network", "hybrid", "ravg"}
# The pages name modules of `hybrid` from these packages on.
PREFIXES = ("", "hybrid.", "hybrid.alignment.", "hybrid.checks.", "hybrid.denoising.", "hybrid.run.")


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imports(path: Path) -> set[str]:
    """Top-level names of all modules that a file imports, wherever in it."""
    names = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("package", ["loops", "flow", "nlm", "network"])
def test_packages_of_arrays_import_none_of_ours(package):
    below = {"loops", "nlm"} if package == "network" else {"loops"}  # the network pools samples as `nlm` does
    for path in (ROOT / package).rglob("*.py"):
        assert not (imports(path) & OURS) - {package} - below, path.name


def test_only_neural_imports_torch_and_the_network():
    files = [path for package in ("flow", "nlm", "hybrid") for path in (ROOT / package).rglob("*.py")]
    assert len(files) > 10
    learned = {path for path in files if imports(path) & {"torch", "network", "safetensors"}}
    assert learned
    # The command states the defaults of a training, which need no torch.
    command = ROOT / "hybrid" / "commands" / "train.py"
    assert {path.parent for path in learned - {command}} == {ROOT / "hybrid" / "neural"}
    assert imports(command) & {"torch", "network", "safetensors"} == {"network"}
    code = "import sys, network.training.config; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def modules_of_hybrid() -> dict[str, set[str]]:
    """Modules of `hybrid`, and which of them each imports, wherever in it."""
    paths = {".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in (ROOT / "hybrid").rglob("*.py")}
    paths = {name.removesuffix(".__init__"): path for name, path in paths.items()}
    graph: dict[str, set[str]] = {}
    for name, path in paths.items():
        found = set()
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.ImportFrom) and node.module:
                found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
            elif isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
        graph[name] = {other for other in found if other in paths and other != name}
    return graph


def package_of(module: str) -> str:
    """Name the row of a module: a top-level package, or a module or package directly in `hybrid`."""
    return module.split(".")[0] if not module.startswith("hybrid.") else ".".join(module.split(".")[:2])


def test_the_table_shows_which_package_imports_which():
    text = (DEVELOPERS / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w.]+)` \| [^|]*\| ([^|]*) \|$", text, re.M)
    drawn = {package: set() if names == "–" else set(names.split(", ")) for package, names in rows}
    built: dict[str, set[str]] = {}
    for path in (path for package in sorted(OURS) for path in (ROOT / package).rglob("*.py")):
        own = package_of(".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"))
        if own == "hybrid":
            continue
        found = built.setdefault(own, set())
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in OURS:
                full = [f"hybrid.{a.name}" for a in node.names] if node.module == "hybrid" else [node.module]
                found |= {package_of(name) for name in full}
            elif isinstance(node, ast.Import):
                found |= {package_of(a.name) for a in node.names if a.name.split(".")[0] in OURS}
        found.discard(own)
    assert drawn == built


def test_no_module_imports_in_a_circle():
    graph = modules_of_hybrid()
    assert graph["hybrid.cli"]
    tuple(TopologicalSorter(graph).static_order())  # raises where there is a circle


def test_the_extension_for_blender_imports_blender_and_nothing_else():
    """It runs in Blender's Python, where nothing of ours is installed."""
    for path in (ROOT / "blender").rglob("*.py"):
        assert imports(path) - {"bpy", "_cycles"} <= sys.stdlib_module_names, path.name


# Modules that are tested by others' files so far. None may join them.
WITHOUT_TESTS_OF_THEIR_OWN = {
    "hybrid/alignment/fireflies.py",
    "hybrid/alignment/prepare.py",
    "hybrid/denoising/breakdown.py",
    "hybrid/commands/inspect.py",
    "hybrid/commands/simulate.py",
    "hybrid/commands/status.py",
    "hybrid/run/memory.py",
    "hybrid/simulate/motion.py",
    "hybrid/simulate/random_assets.py",
    "hybrid/simulate/scene_assets.py",
    "hybrid/simulate/scenes.py",
    "hybrid/simulate/shot.py",
}


@pytest.mark.parametrize("package", sorted(OURS))
def test_a_modules_tests_are_in_the_same_place(package):
    modules = [path.relative_to(ROOT) for path in (ROOT / package).rglob("*.py") if path.name != "__init__.py"]
    assert modules
    without = {
        path.as_posix() for path in modules if not (ROOT / "tests" / path.parent / f"test_{path.name}").is_file()
    }
    assert without <= WITHOUT_TESTS_OF_THEIR_OWN


def test_compiled_loops_leave_the_order_of_arithmetic_alone():
    """With fastmath a process that had compiled a loop gave other last digits than one that found it in the cache.

    Loops that numba makes parallel take four times as long to compile, and a hundred times as long to run where another
    process keeps all cores busy: at the end of each, threads wait for each other without sleeping.
    """
    loops = 0
    for path in (path for package in ("flow", "nlm", "network") for path in (ROOT / package).rglob("*.py")):
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "njit":
                loops += 1
                options = {keyword.arg for keyword in node.keywords}
                assert not options & {"fastmath", "parallel"}, f"{path.name}:{node.lineno}"
    assert loops > 10


def defines(dotted: str) -> bool:
    """Whether a dotted name is a module or package, or a name in a module, or a name in a class of a module."""
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        path = ROOT.joinpath(*parts[:count])
        path = path.with_suffix(".py") if path.with_suffix(".py").is_file() else path / "__init__.py"
        if path.is_file():
            body: list[ast.stmt] | None = parsed(path).body
            for name in parts[count:]:
                body = None if body is None else members(body).get(name)
            return body is not None
    return False


def members(body: list[ast.stmt]) -> dict[str, list[ast.stmt]]:
    """Names that statements define, with the statements of those that are classes."""
    found: dict[str, list[ast.stmt]] = {}
    for node in body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            found[node.name] = node.body if isinstance(node, ast.ClassDef) else []
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found[node.target.id] = []
        elif isinstance(node, ast.Assign):
            found |= {name.id: [] for target in node.targets for name in ast.walk(target) if isinstance(name, ast.Name)}
    return found


def test_names_of_the_glossary_exist():
    page = (DEVELOPERS / "conventions.md").read_text(encoding="utf-8")
    glossary = page.partition("## Glossary")[2].partition("## Words")[0]
    cells = [line.strip("|").split("|")[-1] for line in glossary.splitlines() if line.startswith("| ")]
    cells = [cell for cell in cells if cell.strip() != "code"]
    assert len(cells) > 50
    assert all("`" in cell for cell in cells)
    assert [name for cell in cells for name in re.findall(r"`([\w.]+)`", cell) if not defines(name)] == []
    assert defines("flow")
    assert not defines("hybrid.denoising.plan.NOTHING")
    assert not defines("hybrid.nothing")


def test_names_of_the_architecture_exist():
    page = (DEVELOPERS / "architecture.md").read_text(encoding="utf-8").partition("## The calls of a frame")[2]
    files = [path for package in sorted(OURS) for path in (ROOT / package).rglob("*.py")]
    top: dict[str, list[ast.stmt]] = {}
    for path in files:
        top |= members(parsed(path).body)

    def known(name: str) -> bool:
        owner, _, member = name.partition(".")
        inside = owner in top and (not member or member in members(top[owner]))
        return inside or any(defines(f"{prefix}{name}") for prefix in PREFIXES)

    names = re.findall(r"`([A-Za-z_][\w.]*)`", page)
    assert len(names) > 40
    assert [name for name in names if not known(name)] == []
    assert not known("stream.FrameStream.lose")


def public_functions(path: Path) -> list[ast.FunctionDef]:
    body = parsed(path).body
    return [node for node in body if isinstance(node, ast.FunctionDef) and node.name[0] != "_"]


def parameters(node: ast.FunctionDef) -> list[str]:
    names = [item.arg for item in (*node.args.posonlyargs, *node.args.args)]
    names += [f"*{node.args.vararg.arg}"] if node.args.vararg else []
    names += [item.arg for item in node.args.kwonlyargs]
    return names + ([f"**{node.args.kwarg.arg}"] if node.args.kwarg else [])


def documented_parameters(node: ast.FunctionDef) -> list[str]:
    """Names in the section of parameters; empty where there is none."""
    found = re.search(r"Parameters\n-+\n(.*?)(?=\n\n\w+\n-|\Z)", ast.get_docstring(node) or "", re.DOTALL)
    heads = [line for line in found[1].splitlines() if line and not line.startswith(" ")] if found else []
    assert all(" : " in line for line in heads), f"{node.name}: expected name : type"
    return ", ".join(line.partition(" : ")[0] for line in heads).split(", ") if heads else []


@pytest.mark.parametrize("package", ["flow", "nlm", "network", "hybrid"])
def test_docstrings_name_the_parameters_that_there_are(package):
    """A section of parameters has all of them, in order, and no others."""
    found = [node for path in sorted((ROOT / package).rglob("*.py")) for node in public_functions(path)]
    documented = [node for node in found if documented_parameters(node)]
    assert documented or package == "network"
    for node in documented:
        assert documented_parameters(node) == parameters(node), node.name


def test_functions_that_users_import_document_their_parameters():
    """Shapes of windows, weights and flows stand in `flow` and `nlm` once: few parameters need no section."""
    exported = re.findall(r'"(\w+)"', (ROOT / "ravg" / "__init__.py").read_text(encoding="utf-8").split("__all__")[1])
    modules = [ROOT / "hybrid" / name for name in ("run/arrays.py", "run/job.py", "files/shots.py")]
    functions = [(2, node) for path in modules for node in public_functions(path) if node.name in exported]
    for package in ("flow", "nlm"):
        exported = re.findall(r'"(\w+)"', (ROOT / package / "__init__.py").read_text(encoding="utf-8"))
        public = [node for path in sorted((ROOT / package).rglob("*.py")) for node in public_functions(path)]
        functions += [(4, node) for node in public if node.name in exported]
    assert len(functions) > 50
    for least, node in functions:
        assert len(parameters(node)) < least or documented_parameters(node), f"{node.name} has no section"


SENTENCE = re.compile(r"(?:\A|[.:!?] +|\n\s*\n\s*)((?:What|Of|Whose) [^.?!]*)(?:[.!:]|\Z)")


def texts(path: Path) -> Iterator[str]:
    """Docstrings and comments of a file; comments on adjacent lines are one."""
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            yield ast.get_docstring(node) or ""
    comment: list[str] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.lstrip().startswith("#"):
            comment.append(line.lstrip().lstrip("#:").strip())
        else:
            yield "\n".join(comment)
            comment = []
    yield "\n".join(comment)


def test_no_sentence_begins_with_what_or_of():
    """The subject comes first (docs/dev/conventions.md); questions may begin with "What"."""
    folders = [*sorted(OURS), "benchmarks", "blender", "examples", "tests"]
    files = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    found = [f"{path}: {text}" for path in files for part in texts(path) for text in SENTENCE.findall(part)]
    assert found == []
    assert SENTENCE.findall("It runs. What is left stays.") == ["What is left stays"]
    two = "What is in memory? Of frames, all.\n\nOf all\nothers none"
    assert SENTENCE.findall(two) == ["Of frames, all", "Of all\nothers none"]


def test_the_core_imports_no_peer_at_start():
    """Importing the command must not load what only some of its commands need."""
    code = "import sys, hybrid, hybrid.cli, ravg; print(*sorted({m.split('.')[0] for m in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "typer" in loaded
    assert not {"torch", "numba", "cv2", "skimage", "OpenEXR", "bpy", "oidn"} & set(loaded)


WITHOUT_TORCH = """
import sys
for name in ("torch", "safetensors"):
    sys.modules[name] = None  # what Python does for a module that must not be imported
from hybrid.cli import main
shot, out = sys.argv[1:]
assert main(["inspect", shot]) == 0
assert main(["denoise", shot, "-o", out, "--preset", "draft"]) == 0
sys.exit(main(["denoise", shot, "-o", out + "/network"]))
"""


def test_classical_methods_work_without_torch_and_the_network_says_how_to_get_it(shot_folder, tmp_path):
    command = [sys.executable, "-c", WITHOUT_TORCH, str(shot_folder), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 1
    assert len(list((tmp_path / "out").glob("*.exr"))) == 3
    assert done.stderr.strip().splitlines()[-1].startswith("error: torch is not installed")
    assert 'expected: pip install "torch"' in done.stderr
