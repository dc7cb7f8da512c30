"""Fixtures of the tests of the extension: Blender with it installed, a small scene, and its frames."""

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.blender.session import EXTENSION, NAME, SCENE, VERSION, Blender, blender_extension


@pytest.fixture(scope="session")
def blender(tmp_path_factory: pytest.TempPathFactory) -> Blender:
    """Build the archive, install it as a user would, and enable it."""
    folder = tmp_path_factory.mktemp("blender")
    built = blender_extension("build", "--source-dir", str(EXTENSION), "--output-dir", str(folder))
    assert built.returncode == 0, built.stdout + built.stderr
    (archive,) = folder.glob("*.zip")
    made = Blender(folder / "resources", archive)
    install = """
    bpy.ops.extensions.package_install_files(filepath=ARCHIVE, repo="user_default", enable_on_install=True)
    answer = NAME in bpy.context.preferences.addons
    """
    assert replace(made, installed=False).run(install, ARCHIVE=str(archive), NAME=NAME)
    return made


@pytest.fixture(scope="session")
def stub(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A command that says it is ravg, and makes nothing."""
    path = tmp_path_factory.mktemp("stub") / "ravg"
    path.write_text(f"#!{sys.executable}\nprint('ravg {VERSION}')\n", encoding="utf-8")
    path.chmod(0o755)
    return str(path)


@pytest.fixture(scope="session")
def untouched(blender: Blender, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of somebody who has never heard of passes."""
    path = tmp_path_factory.mktemp("scene") / "shot.blend"
    replace(blender, installed=False).run(SCENE, FILE=str(path))
    return path


@pytest.fixture
def blend(untouched: Path, tmp_path: Path) -> Path:
    """A copy of the scene, in a folder of its own."""
    return Path(shutil.copy(untouched, tmp_path))


@pytest.fixture(scope="session")
def rendered(blender: Blender, untouched: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene set up and its frames rendered; the file's path."""
    path = Path(shutil.copy(untouched, tmp_path_factory.mktemp("rendered")))
    code = """
    from bl_ext.user_default.ravg import scenes
    scene.ravg.noisy = "//frames/shot_"
    bpy.ops.ravg.set_up()
    scenes.override(scene, replace=False)
    bpy.ops.render.render(animation=True)
    scenes.restore(scene)
    bpy.ops.wm.save_mainfile()
    """
    blender.run(code, blend=path)
    return path


@pytest.fixture
def shot(rendered: Path, tmp_path: Path) -> Path:
    """A copy of the scene with its frames."""
    return Path(shutil.copytree(rendered.parent, tmp_path / "shot")) / rendered.name
