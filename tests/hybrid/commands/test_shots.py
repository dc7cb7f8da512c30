from dataclasses import dataclass
from pathlib import Path

import pytest
import typer

from hybrid.commands.shots import ShotInput, expect_views_apart, in_view, parse_layers, views_of


@dataclass(frozen=True)
class Names:
    text: str
    path: Path
    several: tuple[str, ...]
    number: int


def test_the_name_of_a_view_is_put_into_all_names():
    names = Names("%V/a", Path("x_%v.png"), ("albedo=%V/b", "c"), 3)
    assert in_view(names, "left") == Names("left/a", Path("x_l.png"), ("albedo=left/b", "c"), 3)
    assert in_view(names, "") is names


def test_without_a_place_for_views_there_is_one():
    assert views_of("shot.####.exr") == [""]


def test_views_share_folders_alone_and_only_of_different_files():
    views, apart, alike = ["left", "right"], ShotInput(shot="shot_%V.####.exr"), ShotInput(shot="%V/shot.####.exr")
    expect_views_apart(views, apart, {"output": "out"}, {"preview": "x_%V.png"})
    expect_views_apart([""], alike, {"output": "out"}, {"preview": "x.png"})
    for shot, folders, files in (
        (alike, {"output": "out"}, {}),
        (apart, {"output": "out.####.exr"}, {}),
        (apart, {}, {"preview": Path("x.png")}),
        (ShotInput(shot="%V/shot.####.exr", layer=("albedo=a/a.####.exr",)), {}, {}),
    ):
        with pytest.raises(typer.BadParameter, match="expected %V or %v in it"):
            expect_views_apart(views, shot, folders, files)


@pytest.mark.parametrize("layers", [["color"], ["sound=x"], ["color=a", "color=b"]])
def test_layers_are_roles_and_names(layers):
    assert parse_layers(["color=a:b", "albedo=c=d"]) == {"color": "a:b", "albedo": "c=d"}
    with pytest.raises(typer.BadParameter):
        parse_layers(layers)
