import json
import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer

from hybrid.cli import COMMANDS, LazyCommand, main
from hybrid.commands.options import check_first_pass
from hybrid.comparison.metrics import psnr
from hybrid.denoising.first_pass import SPECS
from hybrid.denoising.plan import STAGES
from hybrid.files.exr import read_exr
from hybrid.run.option_texts import option_texts
from hybrid.run.records import read_records
from tests.commands import words_in
from tests.scenes import Scene, grained

ALL = {name: LazyCommand(name, entry).load() for name, entry in COMMANDS.items()}

EXAMPLE = Path(__file__).parents[2] / "examples" / "shot" / "noisy.####.exr"


def run(capsys, *arguments):
    code = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.mark.parametrize("word", ["-h", "--help"])
def test_help_works(capsys, word):
    code, out, _ = run(capsys, word)
    assert code == 0
    assert "--install-completion" in out


def test_the_help_names_each_command_as_the_command_itself_does():
    for name, entry in COMMANDS.items():
        assert ALL[name].help.splitlines()[0] == entry.summary


def test_the_version_is_that_of_the_package(capsys):
    assert run(capsys, "--version")[:2] == (0, f"ravg {version('ravg')}\n")


def test_completion_can_be_had_and_completes(capsys, monkeypatch):
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    code, out, _ = run(capsys, "--show-completion", "bash")
    assert code == 0
    assert "_RAVG_COMPLETE=complete_bash" in out
    done = subprocess.run(
        [sys.executable, "-m", "hybrid.cli"],
        env={**os.environ, "_RAVG_COMPLETE": "complete_bash", "COMP_WORDS": "ravg den", "COMP_CWORD": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == ["denoise"]


@pytest.mark.parametrize("command", ["inspect", "denoise", "compare", "make-clips", "train", "simulate"])
def test_options_have_one_name_and_one_group_everywhere(command, capsys):
    code, out, _ = run(capsys, command, "-h")
    assert code == 0
    assert "Logging" in out
    assert "--output" in out or command == "inspect"
    groups = [line for line in out.splitlines() if line.startswith(("╭", "┌", "+"))]  # the latter on Windows
    assert len(groups) >= 4


# Options of which each command says more: its output, which networks, what is random, how many of what.
SAID_BY_EACH = {"--output", "--preset", "--seed", "--threads", "--tile", "--levels", "--reference", "--resume"}
SAID_BY_EACH |= {"--beside", "--frames", "--window"}


def test_an_option_of_one_name_says_the_same_in_every_command():
    said: dict[str, dict[str, set[str]]] = {}
    for name, command in ALL.items():
        for parameter in command.params:
            for option in parameter.opts:
                said.setdefault(option, {}).setdefault(parameter.help, set()).add(name)
    assert {"denoise", "inspect"} <= set.union(*said["--stages"].values())
    differ = {option for option, helps in said.items() if len(helps) > 1 and option.startswith("--")}
    assert differ <= SAID_BY_EACH | {"--first-pass"}  # make-clips has it "as for denoise"


def test_an_option_of_one_name_stands_in_one_group_of_every_help():
    groups: dict[str, set[str | None]] = {}
    for command in ALL.values():
        for parameter in command.params:
            for option in parameter.opts if parameter.param_type_name == "option" else ():
                groups.setdefault(option, set()).add(parameter.rich_help_panel)
    assert None not in set.union(*groups.values())
    assert {option for option, named in groups.items() if len(named) > 1} <= SAID_BY_EACH


@pytest.mark.parametrize("command", [["denoise", "-o", "x"], ["denoise", "--method=classical", "-o", "x"], ["inspect"]])
def test_a_pattern_that_the_shell_has_replaced_is_to_be_quoted(shot_folder, capsys, command):
    """The error named the other files alone."""
    files = sorted(shot_folder.glob("*.exr"))
    code, _, error = run(capsys, *command, *files)
    assert code == 2
    said = words_in(error)
    assert 'expected one pattern in quotes, such as "*.exr", got 3 files' in said
    assert "in quotes" not in run(capsys, *command, files[0], "more")[2]


def test_inspect_as_json(shot_folder, capsys):
    code, out, _ = run(capsys, "inspect", shot_folder, "--json", "--no-stages", "warp")
    document = json.loads(out)
    assert code == 0
    assert document["frames"] == [1001, 1002, 1003]
    assert (document["width"], document["height"]) == (56, 40)
    assert {"role": "color", "layer": "ViewLayer.Combined", "note": ""} | document["layers"][0] == document["layers"][0]
    assert {d["stage"]: d["forced"] for d in document["plan"]}["warp"]


def test_the_environment_holds_the_defaults_of_a_site(shot_folder, capsys, monkeypatch):
    monkeypatch.setenv("RAVG_MAX_PIXELS", "100")
    assert "100" in one_line_error(capsys, "inspect", shot_folder)
    assert run(capsys, "inspect", shot_folder, "--max-pixels", 10_000)[0] == 0


def test_the_documentation_names_every_default_of_a_site():
    """And each has the name of its option, but for Blender's interpreter, which is no one else's."""
    text = (Path(__file__).parents[2] / "docs" / "command-line.md").read_text(encoding="utf-8")
    there = {
        (str(parameter.envvar), option)
        for command in ALL.values()
        for parameter in command.params
        for option in parameter.opts
        if parameter.envvar and option.startswith("--")
    }
    assert {name for name, _ in there} == set(re.findall(r"`(RAVG_\w+)`", text))
    assert {(n, o) for n, o in there if n != f"RAVG_{o[2:].upper().replace('-', '_')}"} == {
        ("RAVG_BLENDER_PYTHON", "--python")
    }


def test_inspect_names_channels_and_decisions(shot_folder, capsys):
    code, out, _ = run(capsys, "inspect", shot_folder, "-v")
    assert code == 0
    for word in ("ViewLayer.Combined", "Vector", "demodulate", "refine", "off"):
        assert word in out


def test_inspect_begins_with_a_verdict(shot_folder, capsys):
    fine = run(capsys, "inspect", EXAMPLE, "--frames", "8-9")[1]
    better = run(capsys, "inspect", shot_folder)[1]  # its normals and depth do not vary
    assert fine.splitlines()[0] == "This shot is fine."
    assert better.splitlines()[0] == "This shot could be better (normal, depth): 2 warnings say how."
    assert len(fine.splitlines()) == len(better.splitlines()) == 4, "tables are for -v"


def test_one_seed_for_all_frames_is_said_by_inspect_too(tmp_path, capsys):
    """It stood in a table alone, and the verdict was that the shot is fine."""
    scene = Scene(height=96, width=128)

    def edit(index, layers):
        layers["ViewLayer.Combined"][:] = grained(scene.clean(index)["ViewLayer.Combined"], 5)

    folder = scene.write(tmp_path / "in", edit=edit)
    _, out, err = run(capsys, "inspect", folder)
    assert "seed" in out.splitlines()[0]
    assert "warning: constant seed: " in err


def test_noise_that_is_wider_than_any_filter_that_can_be_undone_is_warned_of(tmp_path, capsys):
    def edit(index, layers):
        light = layers["ViewLayer.Combined"]
        noise = cv2.GaussianBlur(np.random.default_rng(index).normal(0, 1, light.shape[:2]), (0, 0), 2)
        light *= np.float32(1 + 0.3 * noise / noise.std())[..., None]

    folder = Scene(height=96, width=128, step=(0, 0)).write(tmp_path / "in", clean=True, edit=edit)
    _, out, err = run(capsys, "inspect", folder)
    assert "pixel filter" in out.splitlines()[0]
    assert "render with a narrower one (docs/renderers.md)" in err
    _, _, err = run(capsys, "denoise", folder, "-o", tmp_path / "out", "--preset", "draft")
    assert "warning: pixel filter: " in err


def test_denoise_writes_denoised_frames_that_keep_everything_else(tmp_path, capsys):
    scene = Scene()
    folder, out = scene.write(tmp_path / "in"), tmp_path / "out"
    preview = tmp_path / "look.png"
    words = ["denoise", folder / "shot.####.exr", "-o", out / "done.####.exr", "--preset", "draft"]
    code, _, err = run(capsys, *words, "--preview", preview)
    assert code == 0, err
    assert preview.stat().st_size > 1000
    for index in range(3):
        before = read_exr(folder / f"shot.{1001 + index}.exr")
        after = read_exr(out / f"done.{1001 + index}.exr")
        assert before.channel_names == after.channel_names
        for name in before.channel_names:
            same = np.array_equal(before.channel(name), after.channel(name))
            assert same == ("Combined" not in name)
        truth = scene.clean(index)["ViewLayer.Combined"]
        pictures = [image.pixels(image.layer("ViewLayer.Combined").channels) for image in (before, after)]
        assert psnr(pictures[1], truth) > psnr(pictures[0], truth) + 3
    ((path, report),) = read_records(out)
    assert path == out / "ravg" / "done.1001-1003.json"
    assert [entry["state"] for entry in report["frames"].values()] == ["made"] * 3
    assert report["state"] == "finished"
    assert report["outliers"] == 0  # there are no fireflies in it
    assert {"read", "prepare", "warp", "write"} <= report["stages"].keys()
    assert all(decision["reason"] for decision in report["plan"])


def test_what_is_not_run_is_said(shot_folder, tmp_path, capsys):
    words = ["denoise", shot_folder, "-o", tmp_path / "o", "--preset", "draft", "--no-stages", "warp"]
    assert "not run" not in run(capsys, *words)[2]
    assert "not run: warp (forced" in " ".join(run(capsys, *words, "-v")[2].split())


def test_a_run_is_ten_lines(tmp_path, capsys):
    shot = Path(__file__).parents[1] / "data" / "bathroom" / "noisy.####.exr"
    _, _, err = run(capsys, "denoise", shot, "-o", tmp_path / "o", "--preset", "draft", "--frames", "8-10")
    lines = [line for line in err.splitlines() if " of 3 frames, " not in line and "compiling" not in line]
    labels = ["Input", "Settings", "Passes", "First", "Output", "Total", "Next", "Details"]
    assert [line.split()[0] for line in lines] == labels
    assert "3 frames" in next(line for line in lines if line.startswith("Output"))


def test_the_help_names_all_stages():
    assert option_texts("denoise")["stages"]["help"].partition(": ")[2].split(", ") == [*STAGES]


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_shows_an_example(capsys, command):
    code, out, _ = run(capsys, command, "--help")
    assert code == 0
    assert f"ravg {command} " in out.partition("Example")[2]


@pytest.mark.parametrize("keep_going", [False, True])
def test_a_frame_that_was_asked_for_and_is_not_there_is_an_error(shot_folder, tmp_path, capsys, keep_going):
    (shot_folder / "shot.1002.exr").unlink()
    words = ["denoise", shot_folder, "-o", tmp_path / "o", "--preset", "draft", "--frames", "1001-1003"]
    code, _, err = run(capsys, *words, *(["--keep-going"] if keep_going else []))
    assert code == 1
    made = {path.name for path in (tmp_path / "o").glob("*.exr")}
    if keep_going:
        assert made == {"shot.1001.exr", "shot.1003.exr"}
        assert err.splitlines()[-1] == "error: frames not made: 1002"
    else:
        assert made == set()
        assert "frames 1002 were asked for and are not there" in err.splitlines()[-1]


@pytest.mark.parametrize("keep_going", [False, True])
def test_a_damaged_frame_ends_the_run_or_is_done_without(tmp_path, capsys, keep_going):
    """With --keep-going all frames whose windows held it failed too, each with the same line."""
    folder, out = Scene(frames=9).write(tmp_path / "in"), tmp_path / "out"
    victim = folder / "shot.1004.exr"
    whole = victim.read_bytes()
    victim.write_bytes(whole[:-2000])
    words = ["denoise", "--method=classical", folder, "-o", out, "--preset", "draft"]
    code, _, said = run(capsys, *words, *(["--keep-going"] if keep_going else []))
    made = {int(path.name.split(".")[1]) for path in out.glob("*.exr")}
    assert code == 1
    assert made == ({*range(1001, 1010)} - {1004} if keep_going else {1001})
    code, text, _ = run(capsys, "status", out, "--json")
    assert code == 1
    (status,) = json.loads(text)["sequences"]
    assert set(status["finished"]) == made
    assert [*status["failed"]] == (["1004"] if keep_going else ["1002"])
    assert [*status["not tried"]] == ([] if keep_going else [str(n) for n in range(1003, 1010)])
    if keep_going:
        assert [line[:20] for line in said.splitlines() if "shot.1004.exr" in line] == [
            "warning: frame 1004:",
            "error: frame 1004: /",
        ]
        # The same pictures as if it were not there.
        victim.unlink()
        assert run(capsys, *words[:3], "-o", tmp_path / "gap", "--preset", "draft")[0] == 0
        for number in made:
            pictures = [read_exr(path / f"shot.{number}.exr") for path in (out, tmp_path / "gap")]
            first, second = (picture.channel("ViewLayer.Combined.R") for picture in pictures)
            np.testing.assert_array_equal(first, second)
        victim.write_bytes(whole)
        code, _, said = run(capsys, *words, "--resume")
        assert code == 0
        again = {int(n) for n in re.findall(r"frame (\d+) is made again", said)}
        assert {1002, 1003, 1005, 1006} <= again


def one_line_error(capsys, *arguments):
    code, _, err = run(capsys, *arguments)
    assert code == 1
    last = [line for line in err.splitlines() if line.strip()][-1]
    assert last.startswith("error: ")
    return last


def test_fireflies_are_counted_in_every_window_they_are_in(tmp_path, capsys):
    def sparks(index, layers):
        if index == 1:
            layers["ViewLayer.Combined"][20, 30] = layers["ViewLayer.Combined"][10, 40] = 1e5

    folder, out = Scene().write(tmp_path / "in", edit=sparks), tmp_path / "out"
    stages = ["--stages", "outliers", "--no-stages", "fireflies"]  # which would take them out of their frame before
    code, _, err = run(capsys, "denoise", folder, "-o", out, "--preset", "draft", *stages)
    assert code == 0, err
    ((_, report),) = read_records(out)
    assert report["outliers"] == 2 * 3  # two, in each of three windows; vectors are whole pixels


@pytest.mark.parametrize("method", ["classical", pytest.param("network", marks=pytest.mark.neural)])
def test_estimates_are_not_overwritten(shot_folder, tmp_path, capsys, method):
    if method == "network":
        pytest.importorskip("torch")
    theirs = Path(shutil.copytree(shot_folder, tmp_path / "theirs"))
    before = {path: path.read_bytes() for path in theirs.iterdir()}
    words = ("denoise", "--method", method, shot_folder, "--first-pass", theirs, "-o", theirs)
    assert "would overwrite an input: first-pass" in one_line_error(capsys, *words)
    assert {path: path.read_bytes() for path in theirs.iterdir()} == before


@pytest.mark.neural
@pytest.mark.parametrize("passes", [1, 2])
@pytest.mark.parametrize("option", ["-o", "--preview", "--breakdown"])
def test_the_input_is_not_overwritten_by_any_pass(shot_folder, tmp_path, capsys, passes, option):
    """The second pass reads what the first has made, and used to write over what that was made from."""
    before = {path: path.read_bytes() for path in shot_folder.iterdir()}
    words = ["denoise", shot_folder, "--first-pass", "nlm", "--passes", passes]
    if option == "-o":
        words += ["-o", shot_folder / "shot.####.exr"]
    else:
        os.link(shot_folder / "shot.1002.exr", tmp_path / "look.png")
        words += ["-o", tmp_path / "out", option, tmp_path / "look.png"]
    assert "overwrite" in one_line_error(capsys, *words)
    assert {path: path.read_bytes() for path in shot_folder.iterdir()} == before
    assert not (tmp_path / "out").exists()  # it was refused before anything was made


def test_an_output_that_is_a_file_is_named(shot_folder, tmp_path, capsys):
    (tmp_path / "o").write_text("not a folder")
    assert str(tmp_path / "o") in one_line_error(
        capsys, "denoise", "--method=classical", shot_folder, "-o", tmp_path / "o" / "x.####.exr"
    )


@pytest.mark.parametrize(
    "arguments",
    [
        ["denoise"],
        ["denoise", "SHOT", "-o", "OUT", "--preset", "best"],
        ["inspect", "SHOT", "--layer", "color"],
        ["inspect", "SHOT", "--layer", "sound=beauty"],
        ["inspect", "SHOT", "--frames", "first-last"],
        ["inspect", "SHOT", "--stages", "polish"],
        ["inspect", "SHOT", "--no-such-option"],
        ["inspect", "SHOT", "--quiet", "--verbose"],
        ["inspect", "SHOT", "--log-format", "prose"],
        ["denoise", "--method=classical", "SHOT", "-o", "OUT", "--first-pass", "best"],
        ["denoise", "--method=classical", "SHOT", "-o", "OUT", "--max-memory", "much"],
        ["denoise", "--method=classical", "SHOT", "-o", "OUT", "--max-memory", "0"],
        ["denoise", "--method=classical", "SHOT", "-o", "OUT", "--max-memory", "8"],
        ["denoise", "--method=classical", "SHOT", "-o", "OUT", "--max-memory", ""],
        ["denoise", "SHOT", "-o", "OUT", "--tile", "0"],
        ["denoise", "SHOT", "-o", "OUT", "--tile", "1e9"],
        ["inspect", "SHOT", "--frames", ""],
        ["inspect", "SHOT", "--frames", "1001-1003x0"],
        ["inspect", "SHOT", "--frames", "1-999999999999"],
        ["denoise", "--method=classical", "SHOT", "-o", "OUT", "--max-memory", "9" * 400],
        ["denoise", "--method=classical", "SHOT", "-o", "OUT", "--max-pixels", "0"],
        ["denoise", "--method=classical", "SHOT", "-o", ""],
        ["denoise", "--method=classical", "SHOT", "-o", "OUT.tif"],
        ["denoise", "--method=classical", "SHOT", "-o", "out.####.PNG"],
        ["denoise", "--method=classical", "SHOT", "-o", "OUT", "--layer", "color="],
        ["compare", "SHOT", "--reference", "SHOT", "--clock", "sun"],
        ["compare", "SHOT", "--reference", "SHOT", "--samples", "0"],
        ["simulate", "random", "-o", "OUT", "--size", "large"],
        ["simulate", "random", "-o", "OUT", "--frames", "a-b"],
        ["simulate", "random", "-o", "OUT", "--animate", "perhaps"],
        ["simulate", "random", "-o", "OUT", "--jobs", "0"],
    ],
)
def test_bad_usage_is_two_and_makes_nothing(arguments, shot_folder, tmp_path, capsys, monkeypatch):
    """No memory at all, and an output of no name or another kind, were found out after a record had been written."""
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    words = {"SHOT": str(shot_folder), "OUT": str(tmp_path / "o")}
    assert run(capsys, *(words.get(word, word) for word in arguments))[0] == 2
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("source", SPECS)
def test_every_source_of_estimates_can_be_asked_for(source):
    assert check_first_pass(source) == source
    with pytest.raises(typer.BadParameter, match=f"first-pass is 'theirs', expected one of .*{source}"):
        check_first_pass("theirs")


@pytest.mark.neural
def test_the_bundled_network_makes_the_estimates_where_asked(shot_folder, tmp_path, capsys):
    words = ["denoise", shot_folder, "-o", tmp_path / "out", "--frames", Scene().first, "--verbose"]
    pictures = []
    for source in ("bundled", "nlm"):
        code, _, _ = run(capsys, *words, "--first-pass", source)
        assert code == 0
        pictures.append(read_exr(tmp_path / "out" / f"shot.{Scene().first}.exr").pixels(("ViewLayer.Combined.R",)))
    assert not np.array_equal(*pictures)


@pytest.mark.neural
@pytest.mark.parametrize(
    "options",
    [
        ["denoise", "SHOT", "-o", "OUT", "--preset", "best"],
        ["denoise", "SHOT", "-o", "OUT", "--precision", "float8"],
        ["denoise", "SHOT", "-o", "OUT", "--threshold", "1"],
        ["denoise", "SHOT", "-o", "OUT", "--tile", "3"],
        ["denoise", "SHOT", "-o", "OUT", "--passes", "0"],
        ["denoise", "SHOT", "-o", "OUT", "--preset", "auto", "--budget", "soon"],
        ["make-clips", "SHOT", "-o", "OUT", "--window", "4"],
        ["make-clips", "SHOT", "-o", "OUT", "--levels", "many"],
        ["make-clips", "SHOT", "-o", "OUT", "--first-pass", "best"],
        ["denoise", "SHOT", "-o", "OUT", "--first-pass", "none", "--breakdown", "weights.jpg"],
        ["train", "SHOT", "-o", "OUT"],
        ["train", "SHOT", "-o", "OUT", "--steps", "1", "--threads", "0"],
        ["train", "SHOT", "-o", "OUT", "--steps", "1", "--preset", "best"],
        ["train", "SHOT", "-o", "OUT", "--steps", "1", "--batch", "0"],
    ],
)
def test_bad_usage_of_the_network_is_two(options, shot_folder, tmp_path, capsys, monkeypatch):
    test_bad_usage_is_two_and_makes_nothing(options, shot_folder, tmp_path, capsys, monkeypatch)


@pytest.fixture
def compared(tmp_path):
    """A noisy shot, its clean frames, and a folder for the report."""
    scene = Scene()
    return scene.write(tmp_path / "hall"), scene.write(tmp_path / "clean", clean=True), tmp_path / "report"


def test_compare_writes_a_report_and_prints_the_table_of_the_readme(compared, capsys):
    noisy, clean, out = compared
    arguments = [noisy, "--reference", clean, "--methods", "noisy,draft", "--rounds", 1]
    code, table, err = run(
        capsys, "compare", *arguments, "-o", out, "--external", f"theirs={clean}", "--samples", 8, "--markdown"
    )
    assert code == 0, err
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    assert rows[0][:2] == ["method", "hall: PSNR (dB) / Temporal PSNR (dB)"]
    assert [row[0] for row in rows[2:]] == ["noisy", "draft", "theirs"]
    assert rows[4][1] == "**∞** / **∞**"
    assert rows[4][2] == "–"  # nobody knows its time
    assert {"report.html", "results.json", "chart.png"} == {path.name for path in out.iterdir()}
    document = json.loads((out / "results.json").read_text(encoding="utf-8"))
    assert set(document["results"][1]["metrics"]) >= {"ssim", "smape", "relmse_trimmed", "mean_bias"}

    # Finished reports are joined without running anything.
    words = ["compare", "--with-report", out, "--with-report", out, "-o", out / "both", "--markdown"]
    _, table, err = run(capsys, *words)
    assert table.splitlines()[0].count("hall: PSNR") == 2
    assert "All shots" in (out / "both" / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("extra", "complaint"),
    [
        (["--methods", "noisy,unheard-of"], "expected one of noisy"),
        (["--external", "nameless"], "expected NAME=PATTERN"),
        (["--external", "noisy=x.exr"], "a name that no other method has"),
        (["--level", "x.####.exr="], "expected PATTERN=SPP"),
        (["--ladder"], "expected --level with it"),
        (["--clock", "sun"], "'wall', 'cpu'"),
    ],
)
def test_compare_refuses_what_it_cannot_do(compared, capsys, extra, complaint):
    noisy, clean, _ = compared
    code, _, err = run(capsys, "compare", noisy, "--reference", clean, *extra)
    assert code == 2
    assert complaint in words_in(err)


def test_compare_wants_something_to_compare(capsys, tmp_path):
    assert run(capsys, "compare")[0] == 2
    code, _, err = run(capsys, "compare", "--with-report", tmp_path)
    assert code == 1
    assert "results.json" in err


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 3.00 GiB for an array"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:117] DefaultCPUAllocator: can't allocate memory: you tried"),
        cv2.error("OpenCV(4.11.0) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate 7 bytes"),
    ],
)
def test_a_lack_of_memory_is_one_line_whoever_says_so(shot_folder, capsys, monkeypatch, error):
    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr("hybrid.commands.inspect.plan_shot", fail)
    assert "not enough memory" in one_line_error(capsys, "inspect", shot_folder)
    monkeypatch.setattr(
        "hybrid.commands.inspect.plan_shot", lambda *_, **__: (_ for _ in ()).throw(RuntimeError("a bug"))
    )
    with pytest.raises(RuntimeError, match="a bug"):
        main(["inspect", str(shot_folder)])
