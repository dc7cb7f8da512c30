"""The table of what was tried, what failed before, and what holds now.

    python benchmarks/hard_cases.py [--before REVISION] [--fuzz 2000] [--damaged FOLDER] [--json OUT]

Runs `tests/hard_cases`, the fuzz of files, and the kills (on `pseudoref` and on `denoise`), and counts. With --before
same tests run on the packages of an older revision too. It takes minutes, and exits with 1 where anything fails.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import xml.etree.ElementTree as ElementTree
from io import BytesIO
from pathlib import Path

ROOT = Path(__file__).parent.parent
NAMES = {
    "test_hard_corrupt": "NaN, Inf and lost frames in any layer",
    "test_hard_light": "exposure, fireflies, cuts, variance, guides",
    "test_hard_motion": "motion vectors that lie",
    "test_hard_sizes": "sizes from 1×1 to 33000 on a side",
    "test_hard_stages": "every stage of flow and nlm (drawn at random)",
    "test_hard_network": "kernels, losses, gradients, metrics",
    "test_hard_weights": "weights files, damaged and hostile",
    "test_hard_checks": "absurd values, estimates and pictures that cannot be right",
    "test_hard_files": "EXR files and the names in them",
    "test_hard_faults": "resume, interrupts, memory, threads",
}


def run(words: list[str], packages: Path) -> subprocess.CompletedProcess[str]:
    """Run a script or pytest with the packages of some folder."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(packages), str(ROOT / "tests" / "hard_cases")])}
    return subprocess.run([sys.executable, "-P", *words], cwd=ROOT, env=environment, capture_output=True, text=True)


def run_tests(packages: Path) -> dict[str, tuple[int, int]]:
    """File → (cases, failed cases) of the tests; a test that draws or loops says how many it stands for."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        words = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "--continue-on-collection-errors", "tests/hard_cases"]
        run([*words, f"--junitxml={report}"], packages)
        counts = dict.fromkeys(NAMES, (0, 0))
        for case in ElementTree.parse(report).iter("testcase"):
            file = case.get("classname", "").rpartition(".")[2] or case.get("name", "").rpartition(".")[2]
            said = [int(p.get("value", "1")) for p in case.iter("property") if p.get("name") == "cases"]
            failed = case.find("failure") is not None or case.find("error") is not None
            if file in counts and case.find("skipped") is None:
                cases = max(said, default=1)
                counts[file] = counts[file][0] + cases, counts[file][1] + cases * failed
    return counts


def extract(revision: str, folder: Path) -> None:
    """Put the packages of a revision into a folder."""
    listed = subprocess.run(["git", "ls-tree", "--name-only", revision], cwd=ROOT, check=True, capture_output=True)
    packages = {"loops", "flow", "nlm", "network", "hybrid"} & set(listed.stdout.decode().split())
    words = ["git", "archive", revision, *sorted(packages)]
    packed = subprocess.run(words, cwd=ROOT, check=True, capture_output=True).stdout
    with tarfile.open(fileobj=BytesIO(packed)) as archive:
        archive.extractall(folder, filter="data")


def last_json(done: subprocess.CompletedProcess[str]) -> dict[str, object]:
    """What a script printed last."""
    if not done.stdout.strip():
        raise RuntimeError(done.stderr)
    result: dict[str, object] = json.loads(done.stdout.strip().splitlines()[-1])
    return result


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--before", metavar="REVISION", help="run the tests on the packages of this revision too")
    parser.add_argument("--fuzz", type=int, default=2000, help="files to damage")
    parser.add_argument("--shots", type=int, default=300, help="made-up shots with one odd window")
    parser.add_argument("--damaged", type=Path, help="folder of damaged EXR files to run on as well")
    parser.add_argument("--json", type=Path, help="write the rows there too")
    options = parser.parse_args(argv)
    now = run_tests(ROOT)
    before = {}
    if options.before:
        with tempfile.TemporaryDirectory() as folder:
            extract(options.before, Path(folder))
            before = run_tests(Path(folder))
    rows = []
    for file, name in NAMES.items():
        cases, failed = now[file]
        # A file whose imports the older packages lack fails as a whole.
        old = None if not before else cases if before[file][0] <= 1 < cases else before[file][1]
        rows.append((name, cases, old, cases - failed))
    scripts = {
        "damaged files (fuzz)": ["benchmarks/fuzz_files.py", "--cases", str(options.fuzz)],
        "kills, stops, no space, two at once: pseudoref": ["benchmarks/kill_runs.py"],
        "kills, stops, no space, two at once: denoise": [
            "benchmarks/kill_runs.py",
            "--command",
            "denoise --estimate nlm",
        ],
    }
    scripts["one odd window in a calm shot"] = ["benchmarks/odd_windows.py", "--shots", str(options.shots)]
    if options.damaged:
        scripts["damaged files (given)"] = ["benchmarks/fuzz_files.py", "--folder", str(options.damaged)]
    for name, words in scripts.items():
        result = last_json(run(words, ROOT))
        if "kills" in result:
            cases = int(str(result["kills"])) + int(str(result["stops"])) + 6
            failed = len(result["problems"])  # type: ignore[arg-type]
        else:
            cases, failed = int(str(result["cases"])), int(str(result["failed"]))
        rows.append((name, cases, None, cases - failed))
    print("| what was tried | cases | failed before | hold now |\n|---|---|---|---|")
    for name, cases, old, holding in rows:
        print(f"| {name} | {cases} | {'–' if old is None else old} | {holding} |")
    total = sum(row[1] for row in rows)
    print(f"| all | {total} | {sum(row[2] or 0 for row in rows)} | {sum(row[3] for row in rows)} |")
    if options.json is not None:
        keys = ("name", "cases", "failed_before", "hold_now")
        options.json.write_text(json.dumps([dict(zip(keys, row, strict=True)) for row in rows], indent=2) + "\n")
    return 0 if all(row[1] == row[3] for row in rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
