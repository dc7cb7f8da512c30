"""The wheel and the sdist hold the packages with their data, and nothing else of the repository."""

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from configparser import ConfigParser
from pathlib import Path

import pytest

from tests.test_structure import OURS, ROOT

# The license's form in setup.cfg needs it; what is built in the tree's own environment asks for no network.
pytest.importorskip("setuptools", minversion="77", reason="builds the wheel: pip install setuptools>=77")
pytest.importorskip("pip", reason="builds the wheel with pip")

CONFIG = ConfigParser()
CONFIG.read(ROOT / "setup.cfg", encoding="utf-8")
VERSION = CONFIG["metadata"]["version"]


def run(folder: Path, *words: str | Path, path: Path | None = None, code: int = 0) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    if path:
        environment["PYTHONPATH"] = str(path)
    done = subprocess.run(
        [sys.executable, *map(str, words)], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done.stderr if code else done.stdout


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the repository without the pixels of examples and docs, since building leaves files in it."""
    place = tmp_path_factory.mktemp("packaging") / "tree"
    left_out = shutil.ignore_patterns(".*", "__pycache__", "build", "dist", "out", "*.egg-info", "*.webp", "*.mp4")
    shutil.copytree(ROOT, place, ignore=left_out, copy_function=copy_small)
    return place


def copy_small(source: str, target: str) -> None:
    """Copy a file; of frames and images the name alone."""
    if source.endswith((".exr", ".png", ".jpg", ".npz", ".blend")):
        Path(target).touch()
    else:
        shutil.copyfile(source, target)


def files_of_packages(tree: Path) -> set[str]:
    return {path.relative_to(tree).as_posix() for name in OURS for path in (tree / name).rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def wheel(tree: Path) -> Path:
    """The wheel of the copy."""
    place = tree.parent
    run(place, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "--no-index", "-w", place, tree)
    return place / f"ravg-{VERSION}-py3-none-any.whl"


@pytest.mark.slow
def test_the_wheel_holds_the_packages_and_runs_from_a_file(wheel, tree, tmp_path):
    place = tmp_path / "installed"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(place)
    info = f"ravg-{VERSION}.dist-info/"
    names = {path.relative_to(place).as_posix() for path in place.rglob("*") if path.is_file()}
    assert {name for name in names if not name.startswith(info)} == files_of_packages(tree)
    assert {f"{info}licenses/LICENSE", f"{info}licenses/NOTICE"} <= names
    for name in OURS:
        assert f"{name}/py.typed" in names
    some = {"network/weights/fast.safetensors", "hybrid/files/profiles/cycles.toml", "hybrid/viewer/page.html"}
    assert some | {"hybrid/files/roles.toml"} <= names
    assert not [name for name in names if name.endswith(".blend")], "scenes are examples"
    assert run(tmp_path, "-m", "ravg", "--version", path=place) == f"ravg {VERSION}\n"
    where = run(tmp_path, "-c", "import ravg; print(ravg.open_shot.__code__.co_filename)", path=place)
    assert Path(where.strip()).is_relative_to(place)
    # As pip leaves it when it removes another distribution that has a package of this name.
    (place / "flow" / "__init__.py").unlink()
    said = run(tmp_path, "-m", "ravg", "--version", path=place, code=1)
    assert said.startswith(f"error: ravg needs its own package flow, expected {place / 'flow' / '__init__.py'}, found ")


def distribution_of_others(folder: Path, names: list[str]) -> Path:
    """A wheel of packages that have the names of ours."""
    info = "theirs-1.dist-info"
    files = {
        f"{info}/METADATA": "Metadata-Version: 2.1\nName: theirs\nVersion: 1\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    for name in names:
        files |= {f"{name}/__init__.py": "OWNER = 'theirs'\n", f"{name}/of_theirs.py": ""}
    path = folder / "theirs-1-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for inside, text in files.items():
            archive.writestr(inside, text)
        archive.writestr(f"{info}/RECORD", "".join(f"{inside},,\n" for inside in [*files, f"{info}/RECORD"]))
    return path


@pytest.mark.slow
def test_beside_a_distribution_with_packages_of_the_same_names(wheel, tmp_path):
    """As docs/install.md says: pip replaces files without a word, and removes them with the other distribution."""
    pytest.importorskip("venv", reason="makes an environment, which Python's embeddable package for Windows cannot")
    names = ["flow", "network", "loops"]
    theirs = distribution_of_others(tmp_path, names)
    place = tmp_path / "environment"
    run(tmp_path, "-m", "venv", "--without-pip", place)
    python = place / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(place), "platbase": str(place)}))
    (packages / "requirements.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")

    def pip(command: str, *words: str | Path) -> None:
        run(tmp_path, "-m", "pip", "--python", python, command, "-q", *words)

    def install(file: Path) -> None:
        pip("install", "--no-index", "--no-deps", "--ignore-installed", file)

    def call(*words: str) -> subprocess.CompletedProcess[str]:
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        return subprocess.run(
            [python, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )

    def owners() -> str:
        code = f"import {', '.join(names)}; print(*(getattr(m, 'OWNER', 'ours') for m in ({', '.join(names)})))"
        return call("-c", code).stdout.strip()

    version = call("-m", "ravg", "--version")
    assert version.returncode == 1, version.stdout
    install(theirs)
    assert owners() == "theirs theirs theirs"
    install(wheel)
    assert owners() == "ours ours ours"
    assert call("-c", "import flow.of_theirs, network.of_theirs, loops.of_theirs").returncode == 0
    assert call("-m", "ravg", "--version").stdout == f"ravg {VERSION}\n"
    install(theirs)
    assert owners() == "theirs theirs theirs"
    assert call("-c", "import ravg; print(ravg.denoise_shot.__module__)").stdout == "hybrid.run.job\n"
    pip("uninstall", "-y", "theirs")
    done = call("-m", "ravg", "--version")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: ravg needs its own package loops, expected ")
    assert done.stderr.endswith("install ravg again, in an environment of its own\n")
    install(wheel)
    assert call("-m", "ravg", "--version").stdout == f"ravg {VERSION}\n"


@pytest.mark.slow
def test_the_sdist_holds_what_builds_the_wheel(tree, tmp_path):
    code = f"from setuptools import build_meta; build_meta.build_sdist({str(tmp_path)!r})"
    run(tree, "-c", code)
    with tarfile.open(tmp_path / f"ravg-{VERSION}.tar.gz") as archive:
        files = {member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()}
    assert {name for name in files if name.partition("/")[0] in OURS} == files_of_packages(tree)
    assert {"setup.cfg", "pyproject.toml", "README.md", "LICENSE", "NOTICE", "constraints.txt", "CHANGELOG.md"} <= files
    folders = {name.partition("/")[0] for name in files if "/" in name}
    assert folders == OURS | {"docs", "ravg.egg-info"}


def test_versions_are_the_same_everywhere():
    manifest = (ROOT / "blender" / "blender_manifest.toml").read_text(encoding="utf-8")
    assert f'\nversion = "{VERSION}"\n' in manifest
    assert f"\nversion: {VERSION}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\n## {VERSION}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"`ravg-{VERSION}.zip`" in (ROOT / "docs" / "blender.md").read_text(encoding="utf-8")
