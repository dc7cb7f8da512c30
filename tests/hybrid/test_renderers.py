"""Files of any renderer: one shot, rewritten as each would have written it, gives one picture."""

import contextlib
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hybrid.cli import main
from hybrid.comparison.metrics import psnr
from hybrid.files.shots import open_shot
from tests.renderers import RENDERERS, Renderer, truths
from tests.seldom import seldom

FRAMES = truths()
ROLES = "albedo", "normal", "depth", "motion", "variance"


def run(command: str, spec: Path, out: Path | None, *options: str) -> str:
    """The output of the command."""
    said = io.StringIO()
    arguments = [command, str(spec), *([] if out is None else ["-o", str(out)]), *options]
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        assert main(arguments) == 0, said.getvalue()
    return said.getvalue()


def pictures(folder: Path) -> dict[int, np.ndarray]:
    shot = open_shot(folder)
    return {number: shot.read(number).color for number in shot.numbers}


def denoised(spec: Path, out: Path, *options: str) -> tuple[dict[int, np.ndarray], str]:
    said = run("denoise", spec, out, "--method=classical", *options)
    return pictures(out), said


def options(renderer: Renderer) -> list[str]:
    """The stages that are asked for: only non-local means read the variance, and they take time."""
    return ["--frames", "10", "--preset", "standard" if "variance" in renderer.roles else "draft"]


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Renderer], np.ndarray]:
    """The picture of the same layers by plain names, with all said that is to say of the motion."""
    folder, kept = tmp_path_factory.mktemp("told"), {}

    def make(renderer: Renderer) -> np.ndarray:
        key = renderer.roles, renderer.direction
        if key not in kept:
            spec = renderer.write_plain(folder / str(len(kept)), FRAMES)
            out = folder / f"out{len(kept)}"
            kept[key] = denoised(spec, out, *options(renderer), "--motion", str(renderer.convention))[0][10]
        return kept[key]

    return make


# Files whose names, encodings and places others have as well.
ALIKE = "arnold, direction and length", "renderman, apart", "vray, prefixed", "3delight"


@pytest.mark.parametrize("name", [*(name for name in RENDERERS if name not in ALIKE), *seldom(*ALIKE)])
def test_the_same_command_gives_the_same_picture(name: str, told, tmp_path: Path) -> None:
    renderer = RENDERERS[name]
    spec = renderer.write(tmp_path / "theirs", FRAMES)
    layers, expected = open_shot(spec).layers(10), {*renderer.roles.split()}
    expected |= {"motion"} if renderer.direction != "none" else set()
    assert {role for role in ROLES if getattr(layers, role) is not None} == expected
    found, said = denoised(spec, tmp_path / "found", *options(renderer), "-v")
    assert "warning" not in said
    assert f"layers: {renderer.profile} (" in said
    # Vectors are rounded otherwise in other units.
    assert psnr(found[10], told(renderer)) > 100


def test_without_vectors_or_with_wrong_ones_the_picture_is_another(told) -> None:
    """Or the test above would show nothing."""
    assert psnr(told(RENDERERS["mitsuba"]), told(RENDERERS["redshift"])) < 51
    assert psnr(told(RENDERERS["nuke"]), told(RENDERERS["redshift"])) < 70


@pytest.mark.parametrize("name", ["arnold", "appleseed"])
def test_inspect_says_which_profile_and_why_and_what_was_tried(name: str, tmp_path: Path) -> None:
    said = run("inspect", RENDERERS[name].write(tmp_path, FRAMES), None, "-v")
    why = {"arnold": "header attribute arnold/version", "appleseed": "layer screen_space_velocity"}[name]
    assert f"profile: {RENDERERS[name].profile} ({why})" in said
    assert "taken" in said
    assert "no motion" in said
