"""How ravg is installed for Blender, without installing it; needs no Blender."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.blender.wheels import load_module, write_wheel

install = load_module("install")


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
    assert new.name == "1"
    install.remove(new)
    assert Path(install.installed(tmp_path)).parts[-3] == old
    install.finish(tmp_path, environment(tmp_path, "1"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1", "current.txt"]


def test_paths_on_windows_leave_room_for_a_name_of_26_letters(tmp_path):
    home = "C:/Users/{}/AppData/Roaming/Blender Foundation/Blender/5.0/extensions/.user/user_default/ravg"
    longest = f"{home.format('u' * 26)}/{install.new_environment(tmp_path).name}/Lib/site-packages/{'t' * 119}"
    assert len(longest) <= 259


def test_what_an_interrupted_installation_has_left_is_removed_by_the_next(tmp_path):
    install.finish(tmp_path, environment(tmp_path, "1"))
    environment(tmp_path, "2")
    made = install.new_environment(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1", made.name, "current.txt"]
    assert install.temporary(made).is_dir()
    install.finish(tmp_path, made)
    assert sorted(path.name for path in tmp_path.rglob("*")) == [made.name, "current.txt"], "no downloads either"


def test_the_size_of_an_environment_is_that_of_its_files(tmp_path):
    assert install.size(tmp_path) == 0
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "torch").write_bytes(bytes(3000))
    (tmp_path / "gone").symlink_to("nowhere")
    assert install.size(tmp_path) == pytest.approx(3e-6, rel=0.02)


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
            install.Source("0.1.4", None, online, False).requirements()
        runs = install.Source("0.1.4", wheel, online, False).requirements()
        named = [word for asked in runs for word in asked if word.startswith("ravg")]
        assert named == [f"ravg[neural] @ {wheel.as_uri()}"]
        assert all(("--no-index" in asked) != online for asked in runs)


@pytest.mark.parametrize(
    ("name", "reason"), [("gone.whl", "no wheel file"), ("torch-2-py3-none-any.whl", "no wheel of ravg")]
)
def test_a_file_that_is_no_wheel_of_ravg_is_refused(tmp_path, name, reason):
    path = tmp_path / name
    if reason != "no wheel file":
        path.touch()
    with pytest.raises((FileNotFoundError, ValueError), match=reason):
        install.Source("0.1.4", path, True, False).requirements()


@pytest.mark.parametrize(
    ("platform", "gpu", "first", "disk"),
    [("linux", False, 1, 1.8), ("linux", True, 0, 6.3), ("win32", True, 0, 1.8), ("darwin", False, 0, 1.8)],
)
def test_linux_gets_torch_for_cpus_unless_it_is_for_gpus(tmp_path, monkeypatch, platform, gpu, first, disk):
    wheel = tmp_path / "ravg-0.1.0-py3-none-any.whl"
    wheel.touch()
    monkeypatch.setattr(install.sys, "platform", platform)
    source = install.Source("0.1.4", wheel, True, gpu)
    runs = source.requirements()
    assert [f"--index-url={install._TORCH_FOR_CPUS}" in asked for asked in runs] == [True] * first + [False]
    assert source.sizes[1] == disk


def index(folder: Path, wheel: Path) -> str:
    """A package index of one wheel; its address."""
    project = folder / wheel.name.partition("-")[0]
    project.mkdir(parents=True)
    (project / "index.html").write_text(f'<a href="{wheel.as_uri()}">{wheel.name}</a>', encoding="utf-8")
    return folder.as_uri()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="pip's torch for other systems is for CPUs")
def test_pip_takes_torch_from_the_index_for_cpus(tmp_path, monkeypatch):
    """With pip itself, and wheels that hold nothing: the default index has a newer torch, for GPUs."""
    pytest.importorskip("pip", reason="installs with pip")
    beside = tmp_path / "beside"
    for folder in ("beside", "cpu", "gpu"):
        (tmp_path / folder).mkdir()
    cpu = write_wheel(tmp_path / "cpu", "torch", "2.6.0+cpu", "")
    gpu = write_wheel(tmp_path / "gpu", "torch", "2.7.0", "")
    write_wheel(beside, "pyoidn", "2.5.1", "")
    ravg = write_wheel(beside, "ravg", "0.1.0", "print('ravg 0.1.0')", "Provides-Extra: neural\nRequires-Dist: torch\n")
    monkeypatch.setattr(install, "_TORCH_FOR_CPUS", index(tmp_path / "for-cpus", cpu))
    for name in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_INDEX_URL", index(tmp_path / "for-gpus", gpu))
    made = install.new_environment(tmp_path / "home")
    for words in install.steps(made, install.Source("0.1.0", ravg, True, False)):
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.strip() == "ravg 0.1.0"
    assert [path.name for path in made.rglob("torch-*.dist-info")] == ["torch-2.6.0+cpu.dist-info"]


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
