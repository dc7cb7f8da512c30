"""`ravg blender-extension`: the extension for Blender as one file, with the wheel of ravg inside."""

import shutil
import subprocess
import sys
import tempfile
import zipfile
from configparser import ConfigParser
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import typer

from hybrid.commands.options import command
from hybrid.files.replace import replace_file

FILES = ("LICENSE", "NOTICE", "README.md", "pyproject.toml", "setup.cfg")  # for the wheel, beside its packages


@command("blender-extension")
def blender_extension(output: str) -> None:
    """Build the wheel, and write it with the extension's files."""
    # An editable install is a clone itself; a regular one is used within a clone.
    roots = Path(__file__).parents[2], Path()
    clones = [root for root in roots if (root / "blender" / "blender_manifest.toml").is_file()]
    if not clones:
        raise FileNotFoundError(f"no folder blender in {Path.cwd()}: the extension is made in a clone of ravg")
    source = clones[0] / "blender"
    with tempfile.TemporaryDirectory() as folder:
        wheel = _build_wheel(clones[0], Path(folder))
        target = Path(output)
        if target.suffix != ".zip":
            target /= f"ravg-{wheel.name.split('-')[1]}.zip"
        target.parent.mkdir(parents=True, exist_ok=True)
        with replace_file(target) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted([*source.glob("*.py"), source / "blender_manifest.toml"]):
                archive.write(path, path.name)
            archive.write(wheel, f"wheels/{wheel.name}")
    typer.echo(f"{target}\nIn Blender: Edit > Preferences > Get Extensions > Install from Disk…")


def _build_wheel(clone: Path, folder: Path) -> Path:
    """Build the wheel from a copy of the packages, since building leaves files in its tree."""
    tree = folder / "tree"
    tree.mkdir()
    config = ConfigParser()
    config.read(clone / "setup.cfg", encoding="utf-8")
    packages = [name.rstrip("*") for name in config["options.packages.find"]["include"].split()]
    for name in (*FILES, *packages):
        if (clone / name).is_dir():
            shutil.copytree(clone / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copyfile(clone / name, tree / name)
    words = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder)]
    if _has_setuptools():  # else pip downloads it
        words.append("--no-build-isolation")
    done = subprocess.run([*words, str(tree)], capture_output=True, encoding="utf-8", errors="replace", check=False)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.strip()] or ["no message"]
        raise OSError(f"pip has not built the wheel of ravg: {lines[-1]}")
    return next(folder.glob("*.whl"))


def _has_setuptools() -> bool:
    """Whether this environment has the setuptools that pyproject.toml asks for."""
    try:
        return int(version("setuptools").split(".")[0]) >= 77
    except PackageNotFoundError:
        return False
