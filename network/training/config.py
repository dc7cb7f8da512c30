"""Settings of a training. The help of `ravg train` says what each means (``run/options.toml``). Needs no torch."""

from dataclasses import dataclass, field

from network.devices import DEVICES

LOSSES = ("l1", "smape", "relmse", "display", "perceptual")
AGAINST = ("input", "start")
TERMS = ("temporal", "power", "spatial")


@dataclass(frozen=True)
class SamplerConfig:
    """How samples are drawn and varied. Probabilities are per sample."""

    crop: int = 128
    sets: int = 10
    pseudo: float = 0.5
    fireflies: float = 0.1  # a few noisy pixels become 10 to 1000 times brighter
    exposure_stops: float = 1.0  # the exposure given to the network is off by up to this, either way

    def __post_init__(self) -> None:
        for name in ("crop", "sets"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected a positive number, got {getattr(self, name)}")
        for name in ("fireflies", "pseudo"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: expected a probability, got {getattr(self, name)}")


@dataclass(frozen=True)
class TrainConfig:
    """One training; with the clips and the model it determines the weights."""

    steps: int | None = None
    minutes: float | None = None
    batch: int = 2
    rate: float = 1e-3
    backbone_rate: float = 0.0
    # The kernels start at a reasonable mean, which a full rate at once would destroy.
    warmup: int = 200
    weight_decay: float = 1e-4
    clip_norm: float = 1.0
    ema: float = 0.999
    # relmse leaves the mean alone.
    loss: str = "relmse"
    vgg: str | None = None
    # By default "start" for given weights, else "input".
    against: str | None = None
    terms: str | None = None
    whole: float = 1.0
    differences: float = 0.0
    slope: float = 1.0
    seed: int = 0
    workers: int = 0
    float32: bool = False
    compile: bool = False
    validate_minutes: float = 5.0
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
        for name, choices in (("loss", LOSSES), ("against", AGAINST), ("terms", TERMS), ("device", DEVICES)):
            value = getattr(self, name)
            if value not in choices and not (name in ("against", "terms") and value is None):
                raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")
        if (self.loss == "perceptual") != (self.vgg is not None):
            raise ValueError("vgg: expected weights with the perceptual loss, and only with it")
        for name, least in (("whole", 0), ("differences", 0), ("slope", 1), ("workers", 0)):
            if not getattr(self, name) >= least:
                raise ValueError(f"{name}: expected at least {least}, got {getattr(self, name)}")
