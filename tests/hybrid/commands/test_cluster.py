"""A Dask cluster: a real scheduler and two workers, one of which dies."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
import typer

from hybrid.cli import main
from hybrid.commands.chunks import arguments_of
from tests.commands import words_in
from tests.hybrid.simulate.test_run import STUB
from tests.hybrid.test_docs import said, transcript
from tests.renderers import save
from tests.scenes import Scene

pytestmark = pytest.mark.cluster
ROOT = Path(__file__).parents[3]
FRAMES = 6
OPTIONS = ["--preset", "draft"]
NOBODY = "tcp://127.0.0.1:9"


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A scheduler's address, and its two workers."""
    pytest.importorskip("distributed")
    folder = tmp_path_factory.mktemp("dask")
    told = folder / "scheduler.json"
    environment = {**os.environ, "DASK_DISTRIBUTED__WORKER__DAEMON": "False"}
    scheduler = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    log = (folder / "log").open("wb")
    running = [
        subprocess.Popen(
            [*scheduler, "--no-dashboard", "--scheduler-file", str(told)], stdout=log, stderr=log, env=environment
        )
    ]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(told), "--no-nanny"]
    worker += ["--nthreads", "1", "--no-dashboard", "--local-directory", str(folder), "--host", "127.0.0.1"]
    for _ in range(2):
        running.append(subprocess.Popen(worker, stdout=log, stderr=log, cwd=ROOT, env=environment))
    try:
        from distributed import Client

        while not told.exists():
            assert running[0].poll() is None, (folder / "log").read_text()
            time.sleep(0.1)
        with Client(scheduler_file=str(told), set_as_default=False) as client:
            address = client.scheduler.address
            client.wait_for_workers(2, timeout=120)
        yield address, running[1:]
    finally:
        for process in running[::-1]:
            process.kill()
            process.wait()
        log.close()


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    return Scene(frames=FRAMES).write(tmp_path_factory.mktemp("shot") / "noisy")


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.glob("*.exr")}


@pytest.fixture(scope="module")
def whole(shot, tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "out"
    assert main(["denoise", str(shot), "-o", str(out), *OPTIONS]) == 0
    return contents(out)


def test_options_are_passed_on_as_they_were_given():
    seen = []
    application = typer.Typer()

    @application.command()
    def denoise(
        context: typer.Context,
        shot: list[str],
        output: Annotated[str, typer.Option("-o", "--output")],
        layer: Annotated[list[str] | None, typer.Option()] = None,
        resume: Annotated[bool, typer.Option("--resume")] = False,
        scheduler: Annotated[str | None, typer.Option()] = None,
        method: Annotated[str, typer.Option()] = "",
    ) -> None:
        seen.append(arguments_of(context, {"resume": True}))

    words = ["a", "-o", "-b", "--layer", "color=x", "--layer", "normal=y", "--scheduler", "tcp://here", "--", "-c"]
    application(words, standalone_mode=False)
    assert seen[0][1:] == ["--output=-b", "--layer=color=x", "--layer=normal=y", "--resume", "--", "a", "-c"]


@pytest.mark.neural
@pytest.mark.posix
def test_what_the_documentation_says(cluster, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    documented = "tcp://192.168.1.10:8786"
    commands = [(words, answer) for (program, *words), answer in transcript("farm.md", "cluster") if program == "ravg"]
    assert len(commands) == 2
    for words, answer in commands:
        assert main([cluster[0] if word == documented else word for word in words]) == 0
        captured = capsys.readouterr()
        lines = [said(line) for line in (captured.out + captured.err).splitlines()]
        for line in answer:
            assert said(line).replace(documented, cluster[0]) in lines


@pytest.mark.posix
def test_random_shots_are_rendered_by_the_workers(cluster, tmp_path, capsys):
    """By a stand-in for Blender, which writes frames that say who has made them."""
    script, python = tmp_path / "stub.py", tmp_path / "python"
    script.write_text(STUB.format(found=0, fail="False"))
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{script}" "$@"\n')
    python.chmod(0o755)
    out = tmp_path / "shots"
    words = ["simulate", "random", "-o", str(out), "--shots", "3", "--seed", "5", "--frames", "1-2", "--levels", "n"]
    assert main([*words, "--python", str(python), "--scheduler", cluster[0]]) == 0, capsys.readouterr().err
    assert {path.name for path in out.iterdir()} == {"random_0005", "random_0006", "random_0007"}
    for folder in out.iterdir():
        assert {path.name for path in folder.glob("*.exr")} == {"noisy.0001.exr", "noisy.0002.exr"}
        assert json.loads((folder / "meta.json").read_text())["shot"]["seed"] == int(folder.name[-4:])
    assert "96 of 96 spp·frames, 100 %" in capsys.readouterr().err


@pytest.mark.neural
def test_clips_are_made_by_the_workers(cluster, tmp_path, capsys):
    shots = [str(Scene(frames=3).write(tmp_path / name)) for name in ("one", "two")]
    words = ["make-clips", *shots, "-o", str(tmp_path / "clips"), "--tile", "0", "--first-pass", "nlm", "--window", "3"]
    assert main([*words, "--scheduler", cluster[0]]) == 0, capsys.readouterr().err
    assert {path.name for path in (tmp_path / "clips").glob("*.safetensors")} == {
        "one.0000.safetensors",
        "two.0000.safetensors",
    }


@pytest.mark.posix
def test_a_shot_is_the_same_bytes_though_a_worker_dies(cluster, shot, whole, tmp_path, capsys):
    address, workers = cluster
    out = tmp_path / "out"

    def kill() -> None:
        while not any(out.glob("*.exr")):  # in the midst of it
            time.sleep(0.05)
        workers[0].send_signal(signal.SIGKILL)

    threading.Thread(target=kill, daemon=True).start()
    words = ["denoise", str(shot), "-o", str(out), *OPTIONS, "--scheduler", address, "--chunk", "2"]
    code = main(words)
    err = capsys.readouterr().err
    assert code == 0, err
    assert "3 chunks for 2 workers" in err
    assert f"{FRAMES} of {FRAMES} frames, 100 %" in err
    workers[0].wait()
    assert contents(out) == whole


def test_a_chunk_that_cannot_be_made_is_told(cluster, tmp_path, capsys):
    folder, out = Scene(frames=8).write(tmp_path / "in"), tmp_path / "out"
    victim = folder / "shot.1008.exr"
    victim.write_bytes(victim.read_bytes()[:-2000])
    words = ["denoise", str(folder), "-o", str(out), *OPTIONS, "--scheduler", cluster[0], "--chunk", "4"]
    assert main(words) == 1
    err = capsys.readouterr().err
    assert "shot.1008.exr" in err
    assert err.splitlines()[-1] == "error: 1 of 2 chunks failed: 1005-1008"
    assert {f"shot.{number}.exr" for number in range(1001, 1005)} <= contents(out).keys()


@pytest.mark.posix
@pytest.mark.usefixtures("interrupts")
def test_ctrl_c_keeps_what_is_finished_and_stops_the_workers(cluster, shot, tmp_path):
    out = tmp_path / "out"
    words = ["denoise", str(shot), "-o", str(out), *OPTIONS, "--scheduler", cluster[0], "--chunk", "1"]
    run = subprocess.Popen([sys.executable, "-m", "hybrid.cli", *words], cwd=ROOT, stderr=subprocess.PIPE, text=True)
    while not any(out.glob("*.exr")):
        assert run.poll() is None
        time.sleep(0.05)
    run.send_signal(signal.SIGINT)
    _, err = run.communicate()
    assert run.returncode == 130, err
    assert "stopped: what is finished is kept; the same command goes on from there" in err
    assert len(contents(out)) < FRAMES


def test_what_cannot_be_written_is_refused_before_anything_is_handed_out(shot, tmp_path, capsys):
    """A preview was looked at when all frames were there."""
    words = ["denoise", "--method=classical", str(shot), "-o", str(tmp_path / "out"), "--scheduler", NOBODY]
    assert main([*words, "--preview", str(tmp_path / "x.tif")]) == 2
    assert "expected a name that ends in .png" in words_in(capsys.readouterr().err)
    assert main([*words, "--contact-sheet", str(tmp_path / "x.png"), "--preview", str(tmp_path / "x.png")]) == 1
    assert "would overwrite preview" in capsys.readouterr().err
    assert main([*words, "-o", str(shot)]) == 1
    assert "would overwrite an input" in capsys.readouterr().err


def test_the_preview_of_several_pictures_is_that_of_the_first(cluster, tmp_path):
    """It ended in an error when all frames were there."""
    for frame in range(2):
        channels = {}
        for name in ("Front", "Back"):
            picture = np.random.default_rng(frame).uniform(size=(12, 16)).astype(np.float32)
            channels |= {f"{name}.Combined.{c}": picture for c in "RGB"}
        save(tmp_path / "in" / f"shot.{frame:04d}.exr", channels)
    words = ["denoise", str(tmp_path / "in"), "-o", str(tmp_path / "out"), *OPTIONS, "--scheduler", cluster[0]]
    assert main([*words, "--preview", str(tmp_path / "x.png")]) == 0
    assert (tmp_path / "x.png").is_file()


def test_no_scheduler_is_one_line(shot, tmp_path, capsys):
    pytest.importorskip("distributed")
    words = ["denoise", "--method=classical", str(shot), "-o", str(tmp_path / "out"), "--scheduler", NOBODY]
    assert main(words) == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"error: no Dask scheduler answers at {NOBODY}")
