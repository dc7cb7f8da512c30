"""What a newcomer types, as the documentation has it, and what is said."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

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
