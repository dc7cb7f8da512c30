"""Modules of the extension, and wheels that hold next to nothing, for tests without Blender."""

import importlib.util
import sys
import zipfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


def write_wheel(folder: Path, name: str, version: str, code: str, extra: str = "") -> Path:
    """Write a wheel of one module, and of a command of the same name that runs one line; further lines of metadata."""
    info, path = f"{name}-{version}.dist-info", folder / f"{name}-{version}-py3-none-any.whl"
    files = {
        f"{name}_stub.py": f"def main():\n    {code or 'pass'}\n",
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n{extra}",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/entry_points.txt": f"[console_scripts]\n{name} = {name}_stub:main\n",
    }
    with zipfile.ZipFile(path, "w") as archive:
        for inside, text in files.items():
            archive.writestr(inside, text)
        archive.writestr(f"{info}/RECORD", "".join(f"{inside},,\n" for inside in [*files, f"{info}/RECORD"]))
    return path


def load_module(name: str) -> Any:
    """A module of the extension that needs no Blender, without the package around it, which imports bpy."""
    spec = importlib.util.spec_from_file_location(f"ravg_blender_{name}", ROOT / "blender" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # dataclasses look it up
    spec.loader.exec_module(module)
    return module
