"""Denoise a shot from another program, as the command does."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator
from functools import partial
from pathlib import Path

from hybrid.estimates import MODE_OF, EstimateSource, choose_estimate
from hybrid.files.shots import Shot
from hybrid.pipeline import Failed, Finished, check_written, denoise_frames, describe_run
from hybrid.plan import NEURAL_STAGES, Rules
from hybrid.pseudo_reference import CLASSICAL_PRESETS, filter_window, gated_average
from hybrid.steady import Denoised, DenoiseWindow
from hybrid.validation import validate_layers


def denoise_shot(
    shot: Shot,
    output: str | Path,
    *,
    preset: str = "fast",
    weights: Path | None = None,
    estimate: str | None = None,
    stages: Collection[str] = (),
    no_stages: Collection[str] = (),
    device: str = "auto",
    resume: bool = False,
    keep_going: bool = False,
) -> Iterator[Finished | Failed]:
    """Denoise every frame of a shot and write it, with the network or without.

    Parameters
    ----------
    shot : Shot
        From `hybrid.open_shot`. Of files with several pictures (stereo, view layers) the first is denoised, or the one
        that was opened as color.
    output : str or Path
        ``OUT.####.exr``, or a folder.
    preset : str
        Of the network: "fast", "balanced", "quality" or "tkpcn". Without one, and without torch: "draft", "standard"
        or "final".
    weights : Path, optional
        A weights file of your own, instead of a preset.
    estimate : str, optional
        Which denoised single frames are made stable (`hybrid.estimates.choose_estimate`). Without: "auto" with the
        network, "none" without one.
    stages, no_stages : collection of str
        Stages that run, or do not, whatever was measured.
    device : str
        What networks are computed on, OIDN's and ravg's alike: "cpu", "cuda", "hip", "sycl" or "metal"; "auto": what is
        there.
    resume : bool
        Leave frames alone that are there and would be made the same.
    keep_going : bool
        Where a frame cannot be made, go on with those after it.

    Yields
    ------
    Finished or Failed
        After each frame.

    Raises
    ------
    ValueError
        An option that does not exist; a file that is damaged, or would be overwritten.
    OSError
        If a file cannot be read or written.
    ImportError
        If the network is asked for and torch is not installed, or OIDN and pyoidn is not.

    Examples
    --------
    >>> from hybrid import denoise_shot, open_shot
    >>> shot = open_shot("examples/shot/noisy.####.exr", frames="8-10")
    >>> [frame.path.name for frame in denoise_shot(shot, "out/denoised.####.exr", preset="draft")]
    ['denoised.0008.exr', 'denoised.0009.exr', 'denoised.0010.exr']
    """
    shot = validate_layers(shot).apply(shot)
    off = set(no_stages)
    denoise: DenoiseWindow
    settings: dict[str, object] = {"aov": shot.aovs}
    neural = weights is not None or preset not in CLASSICAL_PRESETS
    if not neural:
        radius, own = 2, CLASSICAL_PRESETS[preset]
        off |= NEURAL_STAGES
        source = choose_estimate(estimate or "none", shot, own=own, device=device)
        make = partial(filter_window, preset=own) if source.estimates is None else gated_average
        denoise = lambda aligned: Denoised(make(aligned))  # noqa: E731 - as the command has it
    else:
        from hybrid.neural import Denoiser, denoise_bundled, shipped_weights

        path = Path(weights or shipped_weights(preset))
        network = Denoiser(path, device=device)
        content = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
        settings |= {"weights": content, "precision": network.precision, "network": network.device}
        denoise, radius = network, network.radius
        if network.takes_estimate:
            mode = MODE_OF[preset] if weights is None else "oidn-clean"
            source = choose_estimate(
                estimate or "auto",
                shot,
                mode=mode,
                quicker=network.quicker,
                bundled=denoise_bundled,
                device=device,
            )
        else:
            source = EstimateSource("none", None, "this network takes none")
    settings["oidn"] = source.device
    check_written(shot, str(output), [source], {"weights": weights}, {})
    rules = Rules(on=frozenset(stages), off=frozenset(off))
    attributes = describe_run("denoise_shot", preset, source, rules, settings, neural=neural)
    yield from denoise_frames(
        shot,
        output,
        denoise,
        rules,
        radius=radius,
        estimates=source.estimates,
        attributes=attributes,
        resume=resume,
        keep_going=keep_going,
    )
