"""Weights files that are damaged, foreign or hostile: one line that says what, and nothing is run."""

import json
import pickle
import tracemalloc
from contextlib import suppress

import pytest

from tests.scenes import Scene

torch = pytest.importorskip("torch")

from safetensors.torch import save_file  # noqa: E402

from hybrid.cli import main  # noqa: E402
from network.checkpoint import VERSION, describe, load_model, save_model, shipped_weights  # noqa: E402
from network.presets import build_preset  # noqa: E402

pytestmark = pytest.mark.neural


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "good.safetensors"
    save_model(path, build_preset("balanced"))
    return path.read_bytes()


def write(path, model=None, **metadata):
    """A file with the tensors of a model and any metadata; None leaves an entry out."""
    model = model or build_preset("balanced")
    entries = {
        "format": "ravg-network",
        "version": str(VERSION),
        "description": json.dumps(describe(model)),
        "notes": "{}",
    }
    entries = {name: value for name, value in (entries | metadata).items() if value is not None}
    save_file({name: value.half().contiguous() for name, value in model.state_dict().items()}, path, entries)
    return path


def test_a_flipped_bit_is_refused_or_gives_a_finite_model(tmp_path, good, record_property):
    path = tmp_path / "flipped.safetensors"
    positions = range(0, 4000, 200)  # the header
    for position in positions:
        data = bytearray(good)
        data[position] ^= 1 << position % 8
        path.write_bytes(data)
        with suppress(ValueError):  # and nothing else
            assert all(bool(torch.isfinite(p).all()) for p in load_model(path).parameters())
    record_property("cases", len(positions))


class Bomb:
    """Unpickled, it would leave a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


def test_pickles_are_not_opened(tmp_path):
    trace = tmp_path / "trace"
    plain = tmp_path / "model.pkl"
    plain.write_bytes(pickle.dumps(Bomb(trace)))
    archive = tmp_path / "model.pt"
    torch.save({"weights": Bomb(trace)}, archive)
    renamed = tmp_path / "model.safetensors"
    renamed.write_bytes(archive.read_bytes())
    for path in (plain, archive, renamed):
        with pytest.raises(ValueError, match="no safetensors file"):
            load_model(path)
    assert not trace.exists()


@pytest.mark.parametrize(
    ("metadata", "word"),
    [
        ({"format": None}, "expected format 'ravg-network', got None"),
        ({"format": "somebody-elses"}, "expected format 'ravg-network', got 'somebody-elses'"),
        ({"version": "1"}, f"version {VERSION}, got 1"),
        ({"version": "one"}, "version"),
        ({"description": None}, "description"),
        ({"description": "not json"}, "Expecting value"),
        ({"description": "[]"}, "description"),
        ({"description": "null"}, "description"),
        ({"description": "[" * 100_000}, "recursion|Expecting|nest"),
        ({"description": '{"a":' * 100_000}, "recursion|Expecting|nest"),
        ({"description": "1e999"}, "description"),
        ({"description": json.dumps({"model": "os.system", "config": {}})}, "description"),
        ({"description": json.dumps(describe(build_preset("paper")))}, "expected shape"),
    ],
    ids=lambda value: str(value)[:60],  # pytest puts them into an environment variable, which Windows limits
)
def test_wrong_metadata_is_named(tmp_path, metadata, word):
    with pytest.raises(ValueError, match=word):
        load_model(write(tmp_path / "x.safetensors", **metadata))


@pytest.mark.parametrize(
    "changes",
    [
        {"widths": [2**40]},
        {"widths": [16] * 100_000},
        {"widths": [-16, 32]},
        {"widths": []},
        {"widths": "wide"},
        {"nonsense": 1},
        {"kernel": {"frames": 10**9 + 1}},
        {"kernel": {"size": 10**9 + 1}},
        {"kernel": {"size": float("nan")}},
        {"kernel": {"frames": 5.0}},
        {"kernel": None},
    ],
    ids=lambda changes: str(changes)[:40],
)
def test_hostile_sizes_are_refused_before_anything_is_built(tmp_path, changes):
    """A width of 2^40 asked for a terabyte before its shape was compared with the file's."""
    described = describe(build_preset("unet"))
    kernel = changes.get("kernel", {})
    described["config"] |= {name: value for name, value in changes.items() if name != "kernel"}
    described["config"]["kernel"] = described["config"]["kernel"] | kernel if kernel is not None else None
    with pytest.raises(ValueError, match="weights"):
        load_model(write(tmp_path / "x.safetensors", description=json.dumps(described)))


@pytest.mark.parametrize(
    "changes",
    [{"widths": [2**40]}, {"frames": 10**9 + 1}, {"frames": 5.0}, {"threshold": 2}, {"cell": 0}, {"cell": 10**6}],
    ids=str,
)
def test_hostile_sizes_beside_estimates_too(tmp_path, changes):
    described = describe(build_preset("balanced"))
    described["config"] |= changes
    with pytest.raises(ValueError, match="weights"):
        load_model(write(tmp_path / "x.safetensors", description=json.dumps(described)))


def nested(depth):
    described = describe(build_preset("unet"))
    for _ in range(depth):
        described = {"model": "MultiScale", "scales": 2, "base": described}
    return described


@pytest.mark.parametrize("depth", [2, 10, 400])
def test_descriptions_that_nest_are_refused_before_anything_is_built(tmp_path, depth):
    """986 bytes of scales of scales took 22 GB."""
    path = write(tmp_path / "x.safetensors", description=json.dumps(nested(depth)))
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"scales of scales|values within at most") as caught:
        load_model(path)
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("model", "changes", "word"),
    [
        ("paper", {"conv_size": 99}, "conv_size: expected a number up to 15, got 99"),
        ("paper", {"blocks": 255}, "blocks: expected a number up to 64"),
        ("tkpcn", {"temporal_blocks": 255}, "temporal_blocks: expected a number up to 16"),
        ("paper", {"width": 10**400}, "width: expected a number up to 256, got 1000"),
        ("balanced", {"frames": 255}, "frames: expected a number up to 15, got 255"),
        ("unet", {"widths": [256] * 250}, "expected shape|widths"),
        ("unet", {"kernel": {"frames": 5, "size": 255, "threshold": 0.5, "activation": "relu"}}, "size: expected"),
    ],
    ids=["conv_size", "blocks", "temporal", "digits", "frames", "widths", "size"],
)
def test_what_would_take_for_ever_to_run_is_refused_too(tmp_path, model, changes, word):
    described = describe(build_preset(model))
    described["config"] |= changes
    with pytest.raises(ValueError, match=word) as caught:
        load_model(write(tmp_path / "x.safetensors", description=json.dumps(described)))
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("entry", ["format", "version", "description"])
def test_a_message_quotes_no_more_than_a_line(tmp_path, capsys, entry):
    """An entry of a megabyte stood in the message, line by line."""
    path = write(tmp_path / "x.safetensors", **{entry: "x\n" * 500_000})
    with pytest.raises(ValueError, match="weights") as caught:
        load_model(path)
    assert len(str(caught.value)) < 600
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 6e4, -6e4])
def test_weights_that_are_not_finite_or_absurd_are_refused(tmp_path, value):
    """They made every picture NaN."""
    model = build_preset("balanced")
    with torch.no_grad():
        model.backbone.last.weight[0, 0, 0, 0] = value
    with pytest.raises(ValueError, match="finite"):
        load_model(write(tmp_path / "x.safetensors", model))


def test_the_command_says_it_in_one_line_and_writes_nothing(tmp_path, capsys):
    folder = Scene(frames=1).write(tmp_path / "in")
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(shipped_weights("balanced").read_bytes()[:1000])
    assert main(["denoise", str(folder), "-o", str(tmp_path / "out"), "--weights", str(bad)]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[-1].startswith("error: weights")
    assert not (tmp_path / "out").exists()
