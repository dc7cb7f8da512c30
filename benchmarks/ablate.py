"""Accuracy and stability without single stages and rules, as a table: which of them earn their place.

    python benchmarks/ablate.py FOLDER [FOLDER ...] -o ablate.json [--preset fast] [--rules gate agreement]

Folders are those of `benchmarks/ladder.py`. Each rule is switched off alone: a stage, or a function of `RULES`, which
is replaced by one without effect. Figures are the change of PSNR and temporal PSNR by the rule, in dB: above 0 it
gains. Figures that are in the JSON file already are kept, so a run may be stopped and continued.
"""

import argparse
import json
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from ladder import Truth, denoise, levels

import hybrid.alignment.align
import hybrid.alignment.measure
import hybrid.denoising.stabilize
import nlm.samples

STAGES = (
    "gate", "drift", "prefilter", "clean-guides", "stabilize", "restore-mean", "blend-samples", "fireflies",
    "demodulate",
)  # fmt: skip
align, stabilize, samples = hybrid.alignment.align, hybrid.denoising.stabilize, nlm.samples
_stillness, _combine, _means = stabilize.measure_stillness, align.combine_confidence, samples._MEANS


def _ones(estimates: Any, *_: Any) -> Any:
    return np.ones(estimates.shape[1:3], np.float32)


def _keep_picture(first: int, last: int, picture: Any, noisy: Any, *others: Any) -> None:
    _, _, rate, _, blended, error = (part[first:last] if hasattr(part, "shape") else part for part in others)
    blended[:] = picture[first:last]
    limit = samples._LIMIT
    error[:] = np.square(np.clip((noisy[first:last] - blended) * rate[..., None], -limit, limit)).sum(axis=-1)


def _nothing(*_: Any, **__: Any) -> None:
    return None


def _first(picture: Any, *_: Any) -> Any:
    return picture


# Rules within stages: module, name, and the function or constant in its place.
RULES: dict[str, tuple[Any, str, Any]] = {
    "agreement": (align, "agreement_weight", _ones),
    "interpolation": (align, "interpolation_weight", lambda warped, *_: np.ones(warped.shape[:2], np.float32)),
    "outlines agree": (align, "combine_confidence", lambda *a, **k: _combine(*a, **{**k, "least": 0.0})),
    "relight": (align, "relight", _nothing),
    "stillness": (stabilize, "measure_stillness", lambda weight, shape: _stillness(None, shape)),
    "finished detail": (align, "FINISHED_DETAIL", None),
    "limit lamps": (stabilize, "limit_lamps", _first),
    "beside lamps": (stabilize, "beside_lamps", lambda picture, _: np.zeros(picture.shape[:2], bool)),
    "moving lights": (stabilize.FrameDenoiser, "_moving_lights", _nothing),
    "mean of the whole": (samples, "_with_mean", _first),
    "mean over 48": (samples, "_MEANS", _means[1:]),
    "mean over 12": (samples, "_MEANS", _means[::2]),
    "mean of bins": (samples, "_MEANS", _means[:2]),
    "shared detail": (samples, "_blend_shared", _keep_picture),
    "centre's samples": (samples, "_blend_centre", _nothing),
    "light of neighbours": (samples, "_relative_light", lambda n, m, rate: [np.ones_like(rate)] * 2),
    "noise far apart": (samples, "_APART", 1),
    "bound by trusted": (samples, "_MOSTLY", 2.0),
    "outline noise": (hybrid.alignment.measure, "measure_outline_noise", _nothing),
}


def judge(folder: Path, options: argparse.Namespace, results: dict[str, list[float]]) -> None:
    """Add the figures of a shot without each rule to the results, and write these after each."""
    truth = Truth(folder)
    for level in options.levels or levels(folder):
        shot = truth.shot(level)
        for rule in ("", *options.rules):
            if (key := f"{folder.name} {level} {options.preset} {rule}") in results:
                continue
            forced = {"no_stages": (rule,)} if rule in STAGES else {}
            with patch.object(*RULES[rule]) if rule in RULES else nullcontext():
                begun = time.process_time()
                images = denoise(shot, options.preset, **forced)
                seconds = time.process_time() - begun
            results[key] = [*truth.judge(shot, images), round(seconds / len(images), 2)]
            options.output.write_text(json.dumps(results, indent=0), encoding="utf-8")
            print(key, *results[key], flush=True)


def table(results: dict[str, list[float]], preset: str) -> str:
    """Gain of each rule in the mean of a level, and on the shots where it is least and greatest, in Markdown."""
    keys = [key.split(" ", 3) for key in results if key.split(" ")[2] == preset]
    names = list(dict.fromkeys(level for _, level, *_ in keys))
    lines = ["| rule | " + " | ".join(names) + " | least | greatest | CPU time |", "|---" * (len(names) + 4) + "|"]
    for rule in dict.fromkeys(rule for *_, rule in keys if rule):
        gains, cells, shots = [], [], []
        for level in names:
            found = [
                (shot, f"{shot} {level} {preset}") for shot, other, _, name in keys if (other, name) == (level, rule)
            ]
            for shot, key in found:
                gains.append(np.subtract(results[f"{key} "], results[f"{key} {rule}"]))
                shots.append(f"{shot} {level}")
            cells.append(
                " / ".join(f"{gain:+.2f}" for gain in np.mean(gains[-len(found) :], axis=0)[:2]) if found else ""
            )
        for pick in (np.argmin, np.argmax):
            index = int(pick([gain[0] for gain in gains]))
            cells.append(f"{gains[index][0]:+.2f} / {gains[index][1]:+.2f} {shots[index]}")
        lines.append(f"| {rule} | " + " | ".join(cells) + f" | {np.median([gain[-1] for gain in gains]):+.2f} s |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, help="JSON, continued if it is there")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--rules", nargs="+", choices=[*STAGES, *RULES], default=[*STAGES, *RULES], metavar="RULE")
    parser.add_argument("--levels", nargs="+")
    options = parser.parse_args()
    results = json.loads(options.output.read_text(encoding="utf-8")) if options.output.exists() else {}
    for folder in options.folders:
        judge(folder, options, results)
    print(table(results, options.preset))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
