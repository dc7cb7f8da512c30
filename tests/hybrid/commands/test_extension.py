import tomllib
import zipfile
from pathlib import Path

import pytest

from hybrid.cli import main
from hybrid.commands import extension
from tests.seldom import seldom


@pytest.mark.slow
@pytest.mark.parametrize("name", ["", *seldom("made/mine.zip")])
def test_the_extension_holds_its_files_and_the_wheel(tmp_path, capsys, monkeypatch, name):
    if name:  # as a regular install finds them
        monkeypatch.setattr(extension, "__file__", str(tmp_path / "site-packages" / "hybrid" / "extension.py"))
        monkeypatch.chdir(Path(__file__).parents[3])
    pytest.importorskip("setuptools", minversion="77", reason="builds the wheel: pip install setuptools>=77")
    assert main(["blender-extension", str(tmp_path / name)]) == 0
    (path,) = tmp_path.rglob("*.zip")
    assert capsys.readouterr().out.splitlines()[0] == str(path)
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        version = tomllib.loads(archive.read("blender_manifest.toml").decode())["version"]
    assert path.name == (f"ravg-{version}.zip" if not name else "mine.zip")
    assert {"__init__.py", "panel.py", f"wheels/ravg-{version}-py3-none-any.whl"} <= set(names)
    assert not [inside for inside in names if "__pycache__" in inside]


def test_without_a_clone_the_error_says_so(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(extension, "__file__", str(tmp_path / "site-packages" / "hybrid" / "extension.py"))
    monkeypatch.chdir(tmp_path)
    assert main(["blender-extension", str(tmp_path)]) == 1
    assert "the extension is made in a clone" in capsys.readouterr().err


def test_a_wheel_that_cannot_be_built_is_an_error_in_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(extension, "FILES", ("setup.cfg",))
    monkeypatch.setattr(extension.sys, "executable", "/bin/false")
    assert main(["blender-extension", str(tmp_path)]) == 1
    assert capsys.readouterr().err.strip() == "error: pip has not built the wheel of ravg: no message"
