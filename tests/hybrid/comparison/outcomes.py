"""Made-up results of methods."""

from __future__ import annotations

from typing import Any

from hybrid.comparison.results import METRICS, Cost, MethodResult, summarize

PSNR, RELMSE = METRICS[0], next(m for m in METRICS if m.key == "relmse")
SECONDS: Cost = "seconds_per_megapixel"
EVIL = "</script><img src=x onerror='window.pwned=1'> {{data}} & \"q\" | `x`"


def result(name: str, psnr: float | list[float], seconds: float | None, **more: Any) -> MethodResult:
    values = psnr if isinstance(psnr, list) else [psnr - 0.5, psnr, psnr + 0.5]
    metrics = {"psnr": summarize(values), "relmse": summarize([10 ** (-v / 10) for v in values])}
    settings = {"seconds_per_megapixel": seconds, "metrics": metrics, **more}
    return MethodResult(name, **settings)


RESULTS = (
    result("noisy", 22.0, 0.0, family="Input"),
    result("average", 28.0, 0.2, peak_bytes=200 << 20),
    result("slow", 27.0, 2.0, peak_bytes=400 << 20),
    result("final", 34.0, 4.0, peak_bytes=600 << 20, worth=14.2, spread=(3.8, 4.3), settings={"window": 5}),
    result("other", 33.0, None, family="External"),
    MethodResult("gone", absent_reason="torch is not installed"),
)


def swept(name: str, psnr: list[float], seconds: float, **settings: Any) -> MethodResult:
    sweep = "Stages" if next(iter(settings.values())) in ("on", "off") else "Window"
    return result(name, psnr, seconds, family="Methods", settings=settings, sweep=sweep, base="final")


SWEPT = (
    *RESULTS,
    swept("without gate", [32.5, 33.0, 33.5], 3.5, gate="off"),  # steadily a decibel less, for half a second less
    swept("with refine", [33.4, 34.1, 34.4], 9.0, refine="on"),  # scattered about the same
    swept("window 3", [32.0, 32.5, 33.0], 3.0, window=3),
    swept("window 1", [29.0, 29.5, 30.0], 2.5, window=1),
)
