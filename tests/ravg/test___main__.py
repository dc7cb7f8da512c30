"""The package `ravg` and its command, in processes of their own."""

import os
import pydoc
import re
import subprocess
import sys
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path

import pytest

import ravg
from hybrid.files.shots import open_shot
from hybrid.run.job import denoise_shot

ROOT = Path(__file__).parent.parent.parent
PACKAGES = ["loops", "flow", "nlm", "network", "hybrid"]


def python(folder: Path, *words: str, first: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Python in a folder, with `first` before the project on the path."""
    path = os.pathsep.join(str(place) for place in (first, ROOT) if place)
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )


def other(place: Path, name: str) -> Path:
    """A package of somebody else that has the name of one of ours."""
    (place / name).mkdir(parents=True)
    (place / name / "__init__.py").write_text("", encoding="utf-8")
    return place


def test_ravg_exports_what_is_in_hybrid():
    assert ravg.open_shot is open_shot
    assert ravg.denoise_shot is denoise_shot
    assert all(hasattr(ravg, name) for name in ravg.__all__)
    with pytest.raises(AttributeError, match="module 'ravg' has no attribute 'close_shot'"):
        ravg.close_shot  # noqa: B018


def test_importing_ravg_loads_nothing_else(tmp_path):
    code = "import sys, ravg; print(*sorted({m.split('.')[0] for m in sys.modules}))"
    loaded = set(python(tmp_path, "-S", "-c", code).stdout.split())
    assert "ravg" in loaded
    assert not {"hybrid", "numpy", "typer", "torch"} & loaded


def test_the_module_runs_the_command(tmp_path):
    done = python(tmp_path, "-m", "ravg", "--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"ravg {version('ravg')}\n", "")
    assert python(tmp_path, "-m", "ravg", "denoise").returncode == 2


@pytest.mark.parametrize("name", PACKAGES)
def test_a_package_that_hides_one_of_ours_is_named(name, tmp_path):
    theirs = other(tmp_path / "theirs", name)
    done = python(tmp_path, "-m", "ravg", "--version", first=theirs)
    assert done.returncode == 1
    expected = ROOT / name / "__init__.py"
    found = theirs / name / "__init__.py"
    said = f"error: ravg needs its own package {name}, expected {expected}, found {found}: install ravg again"
    assert done.stderr == f"{said}, in an environment of its own\n"
    code = f"import {name}, ravg; ravg.open_shot"
    done = python(tmp_path, "-c", code, first=theirs)
    assert done.stderr.splitlines()[-1].startswith(f"ImportError: ravg needs its own package {name}, expected")


def test_packages_behind_ours_on_the_path_change_nothing(tmp_path):
    for name in PACKAGES:
        other(tmp_path, name)
    code = f"import sys; sys.path.append({str(tmp_path)!r}); import ravg; print(ravg.open_shot.__module__)"
    assert python(ROOT, "-c", code).stdout == "hybrid.files.shots\n"


def test_its_names_and_version_are_those_of_a_package():
    assert {*ravg.__all__} <= {*dir(ravg)}
    assert not {name for name in dir(ravg) if not name.startswith("__")} - {*ravg.__all__}
    assert ravg.__version__ == version("ravg")


def test_help_names_types_and_lists_the_options_in_order():
    said = pydoc.render_doc(ravg, renderer=pydoc.plaintext)
    assert "    denoise_arrays(frames: 'Layers', options: 'DenoiseOptions | None' = None," in said
    assert "    open_shot(spec: 'str | Path'," in said
    attributes = re.findall(r"^     \|  (\w+) : ", said, re.MULTILINE)
    assert attributes[:3] == ["method", "preset", "budget"]
    assert sorted(attributes) == sorted(field.name for field in fields(ravg.DenoiseOptions))
