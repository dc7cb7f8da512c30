"""The documentation: commands run, options and messages exist, links lead somewhere."""

import ast
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

from hybrid.cli import COMMANDS, LazyCommand, main

ROOT = Path(__file__).parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
IDS = [str(page.relative_to(ROOT)) for page in PAGES]
# A marker, which no reader sees, before a block of commands.
BLOCK = re.compile(r"(?:<!-- (?P<marker>[^>]*) -->\n)?```(?P<kind>\w*)\n(?P<text>.*?)\n```", re.DOTALL)
# Options of other programs.
FOREIGN = {
    "--break", "--source-dir", "--command", "--background", "--render", "--keep", "--replace", "--addons", "--python",
    "--python-exit-code", "--chnames", "--chappend", "--no-deps", "--extra-index-url", "--host", "--port",
    "--nworkers", "--nthreads", "--step", "--nproc-per-node", "--threads", "--system-site-packages", "--upgrade",
    "--seed", "--compact", "--second-reference", "--part",
}  # fmt: skip


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


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the examples, as a clone has."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    return tmp_path


@pytest.mark.neural
@pytest.mark.posix
@pytest.mark.usefixtures("folder")
def test_in_a_shell(capsys):
    commands = list(transcript("command-line.md", "transcript"))
    assert len(commands) == 5
    for (program, *words), answer in commands:
        assert program == "ravg"
        code = main(words)
        captured = capsys.readouterr()
        lines = [said(line) for line in (captured.out + captured.err).splitlines()]
        for line in answer:
            assert said(line) in lines
        assert code == (1 if any(word in " ".join(answer) for word in ("not tried", "error")) else 0)


@pytest.mark.neural
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT for other processes")
@pytest.mark.usefixtures("interrupts", "folder")
def test_looking_at_a_shot(capsys):
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
            assert state.read().count(b'"13"') >= 2  # of the frames that are finished, and of those beside them
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 0
    finally:
        process.kill()


def commands_of(page: Path) -> list[tuple[str, list[str]]]:
    """Each block of a page that has commands of ravg, by its marker, with these commands."""
    blocks = []
    for block in BLOCK.finditer(page.read_text(encoding="utf-8")):
        lines = [part for line in block["text"].splitlines() for part in re.split(r" && |; ", line.removeprefix("$ "))]
        if found := [line for line in lines if re.match(r"(ravg|torchrun) ", line)]:
            blocks.append((block["marker"] or "", found))
    return blocks


RUN = [(page, lines) for page in PAGES for marker, lines in commands_of(page) if marker == "run"]


@pytest.mark.neural
@pytest.mark.slow
@pytest.mark.posix
@pytest.mark.parametrize(
    ("page", "lines"),
    [RUN[0], *(pytest.param(*case, marks=pytest.mark.reliability) for case in RUN[1:])],
    ids=[page.name for page, _ in RUN],
)
def test_commands_run(page, lines, folder):
    for line in lines:
        _, *words = shlex.split(line)
        assert main(words) == 0, line
    assert list(folder.glob("out/*.exr")) or lines[0].startswith("ravg inspect")


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_every_command_runs_in_a_test_or_says_why_not(page):
    """Transcripts are compared by tests of their own."""
    for marker, lines in commands_of(page):
        assert marker in ("run", "transcript", "cluster") or marker.startswith("not run: "), lines[0]


def test_an_unmarked_block_of_commands_is_noticed(tmp_path):
    """Or the test above would show nothing."""
    (tmp_path / "page.md").write_text("```sh\nravg denoise shot -o out\n```\n", encoding="utf-8")
    assert commands_of(tmp_path / "page.md") == [("", ["ravg denoise shot -o out"])]


def test_every_system_runs_the_tests_as_the_readme_says():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (line,) = [block["text"] for block in BLOCK.finditer(text) if block["marker"] == "test"]
    assert line.endswith(" && pytest")
    assert f"      - run: {line}\n" in (ROOT / ".github" / "workflows" / "tests.yml").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def options():
    """Command → its options."""
    loaded = {name: LazyCommand(name, entry).load() for name, entry in COMMANDS.items()}
    return {
        name: {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
        for name, command in loaded.items()
    }


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_options_exist(page, options):
    text = page.read_text(encoding="utf-8")
    words = {
        word
        for code in re.findall(r"`[^`]+`|```.*?```", text, re.DOTALL)
        for word in re.findall(r"--[a-z][\w-]*", code)
    }
    known = set().union(*options.values(), FOREIGN, {"--help", "--version", "--install-completion"})
    assert words <= known
    for name, rest in re.findall(r"ravg (\w[\w-]*) ([^`\n]*)", text):
        if name in options:
            rest = rest.partition("&&")[0].partition(" && ")[0]
            own = set(re.findall(r"(?<!\S)--[a-z][\w-]*", rest))
            assert own <= options[name] | {"--help"}, f"ravg {name} {rest}"


def strings_of_the_code() -> list[str]:
    """Every string of the code, with … for values within it."""
    found = []
    for path in (path for package in ("hybrid", "network", "blender") for path in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [part.value if isinstance(part, ast.Constant) else "…" for part in node.values]
                found.append("".join(str(part) for part in parts))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return found


def is_made_by(message: str, strings: list[str]) -> bool:
    """Whether one string of the code has all parts of a message, in their order."""
    pattern = re.compile(".*".join(re.escape(part) for part in message.split("…")), re.DOTALL)
    return any(pattern.search(string) for string in strings)


def test_messages_of_troubleshooting_exist():
    text = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8").partition("## The result")[0]
    messages = re.findall(r"^\| `([^`]+)` \|", text, re.MULTILINE)
    assert len(messages) > 20
    strings = strings_of_the_code()
    assert [message for message in messages if not is_made_by(message, strings)] == []
    assert not is_made_by("frames … are blue", strings)


def anchors(page: Path) -> set[str]:
    """The anchors of the headings of a page, as GitHub makes them."""
    heads = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL), re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if not target.startswith(("http:", "https:")):
            name, _, anchor = target.partition("#")
            path = page.parent / name if name else page
            assert path.exists(), target
            assert not anchor or anchor in anchors(path), target


def test_every_page_is_in_the_index():
    text = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    linked = {(ROOT / "docs" / name).resolve() for name in re.findall(r"\]\(([^)#\s]+)\)", text)}
    assert {page for page in PAGES if page not in (ROOT / "README.md", ROOT / "docs" / "README.md")} <= linked


@pytest.mark.neural
@pytest.mark.posix
@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("index", [0, 1])
def test_python_of_the_documentation_runs(index, capsys):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 2
    exec(compile(blocks[index], "python.md", "exec"), {})
    assert ["10 out/denoised.0010.exr", "2 (270, 480, 3)"][index] in capsys.readouterr().out
