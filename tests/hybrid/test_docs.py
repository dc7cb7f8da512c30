"""What a newcomer types, as the documentation has it, and what is said."""

import os
import re
import shlex
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from hybrid.cli import main

ROOT = Path(__file__).parents[2]


def transcript(document: str, name: str) -> Iterator[tuple[list[str], list[str]]]:
    """Commands of a transcript, and what each is answered."""
    text = (ROOT / "docs" / document).read_text(encoding="utf-8")
    block = re.search(rf"<!-- {name} -->\n```console\n(.*?)```", text, re.DOTALL)
    assert block is not None
    for part in block[1].split("$ ", 1)[1].split("\n$ "):
        command, *answer = part.rstrip("\n").split("\n")
        yield shlex.split(command), answer


def said(line: str) -> str:
    """A line but for its times, which are those of another day."""
    return re.sub(r"\d+(\.\d+)? (s|min|h)\b", "TIME", line)


@pytest.mark.posix
def test_in_a_shell(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    commands = list(transcript("farm.md", "transcript"))
    assert len(commands) == 5
    for (program, *words), answer in commands:
        assert program == "ravg"
        code = main(words)
        captured = capsys.readouterr()
        lines = [said(line) for line in (captured.out + captured.err).splitlines()]
        for line in answer:
            assert said(line) in lines
        assert code == (1 if any(word in " ".join(answer) for word in ("missing", "error")) else 0)


@pytest.mark.neural
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT for other processes")
@pytest.mark.usefixtures("interrupts")
def test_looking_at_a_shot(tmp_path, monkeypatch, capsys):
    pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    ((_, *words), answer), ((_, *look), (url, end)) = transcript("view.md", "transcript")
    assert main(words) == 0
    lines = [said(line) for line in capsys.readouterr().err.splitlines()]
    for line in answer:
        assert said(line) in lines
    command = [sys.executable, "-m", "hybrid.cli", *look, "--no-browser"]
    path = os.pathsep.join([str(ROOT), *sys.path])
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": path})
    try:
        assert process.stdout is not None
        shown = r"http://127\.0\.0\.1:\d+/[\w-]+/"
        here = process.stdout.readline().strip()
        assert re.fullmatch(shown, url)
        assert re.fullmatch(shown, here)
        assert process.stdout.readline().strip() == end
        with urllib.request.urlopen(here + "state", timeout=30) as state:
            assert state.read().count(b'"14"') >= 2  # of the frames that are finished, and of those beside them
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 0
    finally:
        process.kill()
