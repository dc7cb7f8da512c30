"""How ravg is installed for Blender, without installing it; needs no Blender."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[2] / "blender" / "install.py"
spec = importlib.util.spec_from_file_location("ravg_blender_install", SOURCE)
assert spec is not None
assert spec.loader is not None
install = importlib.util.module_from_spec(spec)  # the package around it imports bpy
sys.modules[spec.name] = install  # dataclasses look it up
spec.loader.exec_module(install)


def environment(home: Path, name: str) -> Path:
    """An environment that holds a command."""
    made = home / name
    path = Path(install._program(made, "ravg"))
    path.parent.mkdir(parents=True)
    path.touch()
    return made


def test_nothing_is_installed_until_an_environment_is_complete(tmp_path):
    assert install.installed(tmp_path / "gone") == install.installed(tmp_path) == ""
    made = environment(tmp_path, "1")
    assert install.installed(tmp_path) == ""
    install.finish(tmp_path, made)
    assert install.installed(tmp_path) == install._program(made, "ravg")


@pytest.mark.parametrize("old", ["9", "environment-9"])
def test_a_new_environment_replaces_the_old_one_at_its_end_only(tmp_path, old):
    install.finish(tmp_path, environment(tmp_path, old))
    new = install.new_environment(tmp_path)
    assert new.name == "10"
    environment(tmp_path, "10")
    install.remove(new)
    assert Path(install.installed(tmp_path)).parts[-3] == old
    install.finish(tmp_path, environment(tmp_path, "10"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["10", "current.txt"]


def test_paths_on_windows_leave_room_for_a_name_of_26_letters(tmp_path):
    home = "C:/Users/{}/AppData/Roaming/Blender Foundation/Blender/5.0/extensions/.user/user_default/ravg"
    longest = f"{home.format('u' * 26)}/{install.new_environment(tmp_path).name}/Lib/site-packages/{'t' * 119}"
    assert len(longest) <= 259


def test_an_environment_that_was_removed_is_not_used(tmp_path):
    made = environment(tmp_path, "1")
    install.finish(tmp_path, made)
    install.remove(made)
    assert install.installed(tmp_path) == ""


def test_the_index_is_asked_only_where_that_is_allowed_and_never_for_ravg(tmp_path):
    wheel = tmp_path / "ravg-0.1.0-py3-none-any.whl"
    wheel.touch()
    for online in (True, False):
        with pytest.raises(ValueError, match=r"choose a wheel file of ravg, such as ravg-0\.1\.4-py3"):
            install.Source("0.1.4", None, online).requirements()
        asked = install.Source("0.1.4", wheel, online).requirements()
        assert [word for word in asked if word.startswith("ravg")] == [f"ravg[neural] @ {wheel.as_uri()}"]
    assert "--no-index" in install.Source("0.1.4", wheel, False).requirements()
    assert "--no-index" not in install.Source("0.1.4", wheel, True).requirements()


@pytest.mark.parametrize(
    "line",
    [
        "WARNING: Retrying (Retry(total=0)) after connection broken by 'NewConnectionError(…): [Errno 111] refused'",
        "Temporary failure in name resolution",
        "[Errno 11001] getaddrinfo failed",
    ],
)
def test_a_missing_network_is_named(line):
    log = f"{line}\nERROR: Could not find a version that satisfies the requirement ravg (from versions: none)\n"
    assert "the package index cannot be reached" in install.explain(log, online=True)
    assert "Online Access is off" in install.explain(log, online=False)


def test_another_failure_is_pips_own_first_error():
    log = "Collecting torch\nERROR: No space left on device\nERROR: more\n"
    assert install.explain(log, online=True) == "No space left on device"
    assert install.explain("", online=True) == "no message"
