"""The command `compare`: names that try to be something else, and a page that cannot be made."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid.cli import main
from hybrid.commands.compare import _methods, _seconds
from hybrid.comparison.methods import METHODS
from hybrid.comparison.metrics import psnr
from hybrid.comparison.results import Comparison, read_comparison
from hybrid.files.shots import open_matching_sequence, open_shot
from tests.hybrid.comparison.shots import use_this_process
from tests.scenes import Scene, grained

SMALL = Scene(height=24, width=32, frames=2)
here = pytest.fixture(use_this_process, autouse=True)


@pytest.fixture
def shots(tmp_path: Path) -> tuple[Path, Path]:
    """A noisy shot and its clean frames."""
    return SMALL.write(tmp_path / "noisy"), SMALL.write(tmp_path / "clean", clean=True)


def test_hostile_names_are_shown_as_they_are(shots, tmp_path, capsys, monkeypatch):
    """Markup of the terminal's tables raised an error after everything had run."""
    monkeypatch.setenv("COLUMNS", "200")
    noisy, clean = shots
    names = ["<img/onerror>", "[/bold] [red]", "[bold]", "../up", ".."]
    words = [noisy, "--reference", clean, "--methods", "noisy", "--name", names[0]]
    words += [word for name in names for word in ("--external", f"{name}={clean}")]
    code = main(["compare", *map(str, words), "--rounds", "1", "-o", str(tmp_path / "out" / "report")])
    printed = capsys.readouterr()
    assert code == 0, printed.err
    for name in names:
        assert f"\n{name} " in printed.out
    page = (tmp_path / "out" / "report" / "report.html").read_text(encoding="utf-8")
    assert "<img" not in page
    assert {path.name for path in tmp_path.iterdir()} == {"noisy", "clean", "out"}


@pytest.mark.parametrize("full", [False, True])
def test_a_report_that_cannot_be_written_is_refused_before_anything_runs(full, shots, tmp_path, capsys, monkeypatch):
    """It was found when all methods had run, and their table was lost."""

    def refuse(**_: object) -> None:
        raise OSError(28, "No space left on device")

    place = tmp_path / "report"
    if full:
        monkeypatch.setattr("hybrid.comparison.report.tempfile.TemporaryFile", refuse)
    else:
        place.write_text("mine")
    monkeypatch.setattr("hybrid.commands.compare.compare_shot", lambda *_, **__: pytest.fail("methods ran"))
    noisy, clean = map(str, shots)
    assert main(["compare", noisy, "--reference", clean, "--methods", "noisy", "-o", str(place)]) == 1
    assert f"error: {place}: cannot write a report: " in capsys.readouterr().err


def test_the_table_is_printed_though_the_report_cannot_be_written(shots, tmp_path, capsys, monkeypatch):
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hybrid.comparison.report.write_report", refuse)
    noisy, clean = map(str, shots)
    words = ["compare", noisy, "--reference", clean, "--methods", "noisy", "--rounds", "1", "-o", str(tmp_path / "r")]
    assert main(words) == 1
    assert "noisy" in capsys.readouterr().out


def test_without_jinja_the_page_is_refused_before_anything_runs(shots: tuple[Path, Path], tmp_path: Path) -> None:
    noisy, clean = shots
    code = "import sys; sys.modules['jinja2'] = None; from hybrid.cli import main; sys.exit(main(sys.argv[1:]))"
    words = ["compare", noisy, "--reference", clean, "--methods", "noisy", "-o", tmp_path / "report"]
    done = subprocess.run([sys.executable, "-c", code, *map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.strip().splitlines() == [
        "error: the page of --output needs jinja2, which is not installed; "
        'expected: pip install "jinja2" (the table alone needs neither)'
    ]
    assert not (tmp_path / "report").exists()


def test_movies_are_written_next_to_the_page_on_request(shots: tuple[Path, Path], tmp_path: Path) -> None:
    pytest.importorskip("av")
    noisy, clean = map(str, shots)
    words = ["compare", noisy, "--reference", clean, "--methods", "noisy", "--rounds", "1", "--movies"]
    assert main([*words, "-o", str(tmp_path / "report"), "--fps", "25"]) == 0
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    for name in ("00_reference.mp4", "01_noisy.mp4"):
        assert f'href="movies/{name}"' in page
        assert (tmp_path / "report" / "movies" / name).is_file()
    assert '<option value="25" selected>' in page
    assert main(words) == 2
    # Somebody else's folder of that name is left alone.
    (tmp_path / "other" / "movies").mkdir(parents=True)
    assert main([*words, "-o", str(tmp_path / "other")]) == 1


def test_layers_are_judged_as_everywhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One warning, a word in the report's facts, an error where that is asked for; and a motion that is said holds."""

    def black(index: int, layers: dict[str, np.ndarray]) -> None:
        layers["ViewLayer.Denoising Albedo"][:] = 0

    noisy, clean = SMALL.write(tmp_path / "noisy", edit=black), SMALL.write(tmp_path / "clean", clean=True)
    words = ["compare", str(noisy), "--reference", str(clean), "--methods", "noisy", "--rounds", "1"]
    assert main([*words, "-o", str(tmp_path / "report"), "--motion", "none"]) == 0
    said = "albedo (ViewLayer.Denoising Albedo.RGB) is black: left out"
    assert " ".join(capsys.readouterr().err.split()).count(said) == 1
    assert said in read_comparison(tmp_path / "report" / "results.json").facts["Layers"]
    assert main([*words, "--strict"]) == 1
    assert said in " ".join(capsys.readouterr().err.split())
    assert main([*words, "--motion", "sideways"]) == 2
    assert main([*words, "--profile", "nobody"]) == 2


def test_a_cut_is_said_before_methods_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def cut(index: int, layers: dict[str, np.ndarray]) -> None:
        if index:
            for name in ("ViewLayer.Combined", "ViewLayer.Denoising Albedo"):
                layers[name][:] = layers[name][::-1].copy()

    scene, bare = replace(SMALL, height=64, width=96), {"Denoising Normal", "Depth", "Vector"}
    noisy = scene.write(tmp_path / "noisy", edit=cut, without=bare)
    clean = scene.write(tmp_path / "clean", edit=cut, without=bare, clean=True)
    words = ["compare", str(noisy), "--reference", str(clean), "--methods", "noisy", "--rounds", "1"]
    assert main([*words, "--strict"]) == 1
    said = "cut between frames 1001 and 1002: nothing is averaged across it"
    assert said in " ".join(capsys.readouterr().err.split())
    assert main(words) == 0
    assert said in " ".join(capsys.readouterr().err.split())


def results_of(folder: Path) -> Comparison:
    return read_comparison(folder / "results.json")


def write_noisy(folder: Path, seed: int, noise: float) -> Path:
    """Frames of the small shot with noise of another seed and strength."""

    def edit(index: int, layers: dict[str, np.ndarray]) -> None:
        layers["ViewLayer.Combined"] = grained(layers["ViewLayer.Combined"], (seed, index), noise)

    return SMALL.write(folder, clean=True, edit=edit)


def test_five_methods_run_where_none_is_named(shots: tuple[Path, Path]) -> None:
    """All ran, for an hour, of which most are parts of others."""
    shot = open_shot(str(shots[0]))
    assert [*_methods(None, None, {}, shot, None)] == ["noisy", "OIDN high", "OIDN best", "balanced", "quality"]
    assert _methods("all", None, {}, shot, None) == METHODS
    assert [*_methods("fast, noisy", None, {}, shot, None)] == ["fast", "noisy"]


def test_both_references_are_read(tmp_path: Path) -> None:
    """With the second one ignored, the noise of the first would count as an error of the method."""
    noisy, clean = SMALL.write(tmp_path / "noisy"), SMALL.write(tmp_path / "clean", clean=True)
    halves = [write_noisy(tmp_path / f"half{seed}", seed, 0.1) for seed in (5, 6)]
    words = ["compare", str(noisy), "--methods", "noisy", "--external", f"clean={clean}", "--rounds", "1"]
    for name, chosen in (("one", halves[:1]), ("two", halves)):
        references = [word for half in chosen for word in ("--reference", str(half))]
        assert main([*words, *references, "-o", str(tmp_path / name)]) == 0
    one, two = results_of(tmp_path / "one"), results_of(tmp_path / "two")
    assert two.facts["Reference"].startswith("Two independent halves")
    assert not one.facts["Reference"].startswith("Two independent halves")
    assert two.results[1].metrics["psnr"].mean > one.results[1].metrics["psnr"].mean + 3


def test_exposure_reaches_the_measures(shots: tuple[Path, Path], tmp_path: Path) -> None:
    noisy, clean = shots
    words = ["compare", str(noisy), "--reference", str(clean), "--methods", "noisy", "--rounds", "1"]
    assert main([*words, "--exposure", "4", "-o", str(tmp_path / "report")]) == 0
    image, reference = (open_shot(folder).read(SMALL.first).color for folder in shots)
    statistic = results_of(tmp_path / "report").results[0].metrics["psnr"]
    assert statistic.values[0] == pytest.approx(psnr(image, reference, exposure=4))
    assert statistic.values[0] != pytest.approx(psnr(image, reference), abs=0.1)


def test_levels_are_measured(shots: tuple[Path, Path], tmp_path: Path) -> None:
    noisy, clean = shots
    level = write_noisy(tmp_path / "level", 9, SMALL.noise / 2)
    words = ["compare", str(noisy), "--reference", str(clean), "--methods", "noisy", "--rounds", "1"]
    words += ["--samples", "8", "--level", f"{level}=32", "-o", str(tmp_path / "report")]
    assert main(words) == 0
    said = results_of(tmp_path / "report").facts["Worth in samples"]
    scores = []
    for number in (SMALL.first, SMALL.first + 1):
        image, reference = (open_shot(folder).read(number).color for folder in (level, clean))
        scores.append(10 ** (-psnr(image, reference) / 10))
    assert f"32: {-10 * np.log10(np.mean(scores)):.2f} dB" in said


def test_a_ladder_is_printed_and_joined_with_others(shots, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(METHODS, "OIDN best", METHODS["aligned average"])  # OIDN need not be installed
    noisy, clean = shots
    level = write_noisy(tmp_path / "level", 9, SMALL.noise / 2)
    words = ["compare", str(noisy), "--reference", str(clean), "--rounds", "1", "--ladder", "--samples", "8"]
    words += ["--methods", "noisy,OIDN best,aligned robust average"]
    report = tmp_path / "report"
    assert main([*words, "--level", f"{level}=32", "-o", str(report), "--markdown"]) == 0
    printed = capsys.readouterr().out
    head, rule, *rows = printed.splitlines()[-5:]
    assert head.endswith(" | by | 8 spp | 32 spp |")
    assert rule == "| --- | --- | --- | --- |"
    measures = ("PSNR", "Temporal PSNR", "FLIP")
    assert [row.split(" | ")[:2] for row in rows] == [["| aligned robust average", by] for by in measures]
    assert (report / "ladder.png").exists()
    ladder = results_of(report).ladder
    errors = {name: dict(curve) for name, curve in ladder["psnr"].items()}
    assert errors["noisy"][32] < errors["noisy"][8]
    assert errors["OIDN best"][8] < errors["noisy"][8]
    others = ["--with-report", str(report), "--with-report", str(report)]
    assert main(["compare", *others, "-o", str(tmp_path / "both")]) == 0
    assert "8 spp" in capsys.readouterr().out
    joined = results_of(tmp_path / "both").ladder
    assert joined.keys() == ladder.keys()
    assert dict(joined["psnr"]["noisy"]) == pytest.approx(errors["noisy"])


def test_samples_of_a_level_come_from_its_files_or_are_asked_for(shots, tmp_path, capsys):
    noisy, clean = shots
    words = ["compare", str(noisy), "--reference", str(clean), "--methods", "noisy", "--rounds", "1", "--samples", "8"]
    assert main([*words, "--level", str(noisy)]) == 1
    assert "does not state its samples per pixel, expected --level PATTERN=SPP" in capsys.readouterr().err
    bundled = Path(__file__).parents[3] / "examples" / "shot"
    noisy, clean = bundled / "noisy.####.exr", bundled / "reference_a.####.exr"
    words = ["compare", str(noisy), "--reference", str(clean), "--methods", "noisy", "--rounds", "1", "--frames", "11"]
    assert main([*words, "--level", str(bundled / "reference_b.####.exr"), "-o", str(tmp_path / "report")]) == 0
    assert ", 96: " in results_of(tmp_path / "report").facts["Worth in samples"]


def test_frames_are_kept_and_the_time_of_others_is_theirs_to_state(tmp_path: Path) -> None:
    pytest.importorskip("jinja2")
    noisy, clean = SMALL.write(tmp_path / "noisy"), SMALL.write(tmp_path / "clean", clean=True)
    words = ["compare", str(noisy), "--reference", str(clean), "--methods", "noisy", "--external", f"mine={clean}"]
    words += ["--rounds", "1", "-o", str(tmp_path / "report")]
    assert main([*words, "--external-seconds", "mine=1.0", "--keep-frames"]) == 0
    results = {result.name: result for result in results_of(tmp_path / "report").results}
    pixels = SMALL.height * SMALL.width
    assert results["mine"].seconds_per_megapixel == pytest.approx(1e6 / pixels)
    kept = {folder.name: sorted(folder.iterdir()) for folder in (tmp_path / "report" / "frames").iterdir()}
    assert kept.keys() == {"00_reference", "01_noisy", "02_mine"}
    shot, made = open_shot(clean), open_shot(tmp_path / "report" / "frames" / "02_mine")
    assert made.numbers == shot.numbers
    np.testing.assert_array_equal(made.read(shot.numbers[0]).color, shot.read(shot.numbers[0]).color)
    for wrong in ("mine", "mine=0", "mine=-1", "other=2", "=3"):
        assert main([*words, "--external-seconds", wrong]) == 2
    assert main([*words[:-2], "--keep-frames"]) == 2


def test_seconds_are_those_of_their_method() -> None:
    assert _seconds(["mine=2.5", "a=b=3"]) == {"mine": 2.5, "a=b": 3}


def test_references_have_the_frames_and_levels_of_a_ladder_are_validated(shots, monkeypatch):
    noisy, clean = map(str, shots)
    frames, validated = [], []

    def note_frames(*args: object, **options: object) -> object:
        frames.append(options["frames"])
        return open_matching_sequence(*args, **options)

    def note_names(renders: dict[str, object], *, strict: bool) -> tuple[dict[str, object], list[str]]:
        validated.append((*renders, strict))
        return renders, []

    def compare_shot(*args: object, **options: object) -> Comparison:
        raise OSError("enough")

    monkeypatch.setattr("hybrid.commands.compare.open_matching_sequence", note_frames)
    monkeypatch.setattr("hybrid.commands.compare.validate_renders", note_names)
    monkeypatch.setattr("hybrid.commands.compare.compare_shot", compare_shot)
    first = str(open_shot(noisy).numbers[0])
    words = ["compare", noisy, "--reference", clean, "--frames", first, "--level", f"{noisy}=8", "--strict"]
    for ladder, expected in (([], [("shot", True)]), (["--ladder"], [("shot", True), ("level", True)])):
        validated.clear()
        assert main([*words, *ladder, "--methods", "noisy", "--samples", "4"]) == 1
        assert validated == expected
    assert frames == [first, first]
