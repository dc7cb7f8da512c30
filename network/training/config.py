"""What determines a training. Nothing here needs torch, so that a command can tell the defaults without it."""

from __future__ import annotations

from dataclasses import dataclass, field

LOSSES = ("l1", "smape", "relmse", "display", "perceptual")
TERMS = ("temporal", "power", "spatial")
DEVICES = ("auto", "cpu", "cuda", "hip", "sycl", "metal")


@dataclass(frozen=True)
class SamplerConfig:
    """How samples are drawn and varied. Probabilities are per sample."""

    crop: int = 128  # height and width; of larger clips a place is drawn by importance
    sets: int = 10  # disjoint sets of clips, one for each epoch; the paper's ten
    drop_frames: float = 0.1  # a side frame loses its confidence and becomes the centre, as at a shot's ends
    fireflies: float = 0.1  # a few noisy pixels become 10 to 1000 times brighter
    pseudo: float = 0.5  # a target is a pseudo-reference, where there are renders of as many samples too
    exposure_stops: float = 1.0  # the exposure the network is told is off by up to this, either way

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

    steps: int | None = None  # stop after so many steps; reproducible from the seed
    minutes: float | None = None  # or after so long, whichever comes first
    batch: int = 2  # of all processes together
    rate: float = 1e-3  # peak learning rate
    trunk_rate: float = 0.1  # share of it that the trunk of a RobustUNet is trained with; 0 leaves it as it is
    warmup: int = 200  # steps of linear rise; the kernels start at a sane mean, and must not be thrown off it
    weight_decay: float = 1e-4
    clip_norm: float = 1.0  # largest norm of the gradient; one firefly is one sample
    ema: float = 0.999  # of the weights that are validated and kept
    loss: str = "relmse"  # which leaves the mean alone: one of LOSSES
    vgg: str | None = None  # weights of VGG19 in torchvision's format, or hub; for perceptual
    terms: str = "temporal"  # parts of the window that must give the target: one of TERMS
    whole: float = 1.0  # weight of the whole window's term beside the temporal ones
    differences: float = 0.0  # weight of what the errors of two neighbouring pictures differ by, along the motion
    slope: float = 1.0  # λ of Vogels' asymmetric loss; for clean targets
    bfloat16: bool = True  # for the convolutions, where the device has it; kernels and losses are float32
    compile: bool = False  # torch.compile the network: a minute at the start, pays on a GPU
    device: str = "auto"  # the GPU if there is one
    workers: int = 0  # processes that read clips; 0: the training itself
    seed: int = 0
    checkpoint_minutes: float = 5.0
    validate_minutes: float = 5.0
    sampler: SamplerConfig = field(default_factory=SamplerConfig)

    def __post_init__(self) -> None:
        if self.steps is None and self.minutes is None:
            raise ValueError("steps, minutes: expected at least one limit, got none")
        for name in ("steps", "minutes", "batch", "rate", "clip_norm"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name}: expected a positive number, got {value}")
        if not 0 <= self.trunk_rate <= 1:
            raise ValueError(f"trunk_rate: expected 0 to 1, got {self.trunk_rate}")
        if not 0 <= self.ema < 1:
            raise ValueError(f"ema: expected 0 <= ema < 1, got {self.ema}")
        for name, choices in (("loss", LOSSES), ("terms", TERMS), ("device", DEVICES)):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {getattr(self, name)!r}")
        if (self.loss == "perceptual") != (self.vgg is not None):
            raise ValueError("vgg: expected weights with the perceptual loss, and only with it")
        for name, least in (("whole", 0), ("differences", 0), ("slope", 1)):
            if not getattr(self, name) >= least:
                raise ValueError(f"{name}: expected at least {least}, got {getattr(self, name)}")
