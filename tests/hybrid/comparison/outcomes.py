"""Made-up results of methods."""

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
