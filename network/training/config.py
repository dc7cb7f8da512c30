"""Settings of a training, with defaults and help texts for options of `ravg train`; importing this needs no torch."""

from dataclasses import dataclass, field
from typing import Annotated

from network.devices import DEVICES

LOSSES = ("l1", "smape", "relmse", "display", "perceptual")
TERMS = ("temporal", "power", "spatial")
# The second is the former name of the option.
BACKBONE = {"names": ("--backbone-rate", "--trunk-rate")}


@dataclass(frozen=True)
class SamplerConfig:
    """How samples are drawn and varied. Probabilities are per sample."""

    crop: Annotated[int, "pixels on a side of a sample; drawn by importance from larger clips"] = 128
    sets: Annotated[int, "disjoint sets of clips, one for each epoch; the paper's ten"] = 10
    drop_frames: Annotated[float, "chance that side frames of a sample are dropped, as at the ends of a shot"] = 0.1
    pseudo: Annotated[float, "chance of a pseudo-reference as target where there are renders too"] = 0.5
    fireflies: float = 0.1  # a few noisy pixels become 10 to 1000 times brighter
    exposure_stops: float = 1.0  # the exposure given to the network is off by up to this, either way

    def __post_init__(self) -> None:
        for name in ("crop", "sets"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected a positive number, got {getattr(self, name)}")
        for name in ("drop_frames", "fireflies", "pseudo"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: expected a probability, got {getattr(self, name)}")


@dataclass(frozen=True)
class TrainConfig:
    """One training; with the clips and the model it determines the weights."""

    steps: Annotated[int | None, "stop after so many steps; reproducible from the seed"] = None
    minutes: Annotated[float | None, "stop after so many minutes"] = None
    batch: Annotated[int, "samples of a step, of all processes together"] = 2
    rate: Annotated[float, "peak learning rate"] = 1e-3
    backbone_rate: Annotated[float, "factor of the rate for a pretrained backbone; 0: frozen", BACKBONE] = 0.1
    # The kernels start at a reasonable mean, which a full rate at once would destroy.
    warmup: Annotated[int, "steps in which the rate rises to its peak"] = 200
    weight_decay: float = 1e-4
    clip_norm: Annotated[
        float, "largest norm of a gradient, as one sample may hold a firefly", {"names": ("--clip",)}
    ] = 1.0
    ema: Annotated[float, "decay of the moving average of the weights, which is validated and saved"] = 0.999
    # relmse leaves the mean alone.
    loss: Annotated[str, "relmse, l1, smape, display (for clean targets), or perceptual (with --vgg)"] = "relmse"
    vgg: Annotated[str | None, "torchvision's VGG19 weights: a file, or hub to download them"] = None
    terms: Annotated[
        str | None, "of networks that predict kernels: temporal, power (every subset of the window), or spatial"
    ] = None
    whole: Annotated[float, "weight of the term of the whole window beside the temporal terms"] = 1.0
    differences: Annotated[
        float, "weight of the error of differences between frames, along the motion (clips of whole frames: --tile 0)"
    ] = 0.0
    slope: Annotated[float, "λ of the asymmetric loss, for clean targets: more than 1 leaves noise before detail"] = 1.0
    seed: Annotated[int, "seed of initial weights and samples"] = 0
    workers: Annotated[int, "processes that read clips; 0: the training itself"] = 0
    float32: Annotated[bool, "compute convolutions in float32 where the device has bfloat16 too"] = False
    compile: Annotated[bool, "compile the network: a minute at the start, pays on a GPU"] = False
    validate_minutes: Annotated[float, "minutes between validations, and between checkpoints"] = 5.0
    device: str = "auto"
    sampler: SamplerConfig = field(default_factory=SamplerConfig)

    def __post_init__(self) -> None:
        if self.steps is None and self.minutes is None:
            raise ValueError("steps, minutes: expected at least one limit, got none")
        for name in ("steps", "minutes", "batch", "rate", "clip_norm"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name}: expected a positive number, got {value}")
        if not 0 <= self.backbone_rate <= 1:
            raise ValueError(f"backbone_rate: expected 0 to 1, got {self.backbone_rate}")
        if not 0 <= self.ema < 1:
            raise ValueError(f"ema: expected 0 <= ema < 1, got {self.ema}")
        for name, choices in (("loss", LOSSES), ("terms", TERMS), ("device", DEVICES)):
            value = getattr(self, name)
            if value not in choices and not (name == "terms" and value is None):
                raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")
        if (self.loss == "perceptual") != (self.vgg is not None):
            raise ValueError("vgg: expected weights with the perceptual loss, and only with it")
        for name, least in (("whole", 0), ("differences", 0), ("slope", 1), ("workers", 0)):
            if not getattr(self, name) >= least:
                raise ValueError(f"{name}: expected at least {least}, got {getattr(self, name)}")
