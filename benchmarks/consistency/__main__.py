"""`python -m benchmarks.consistency [--quick]`: writes results/README.md and its figures."""

import argparse
import datetime
import platform
import shlex
import sys
from pathlib import Path

import jax

from benchmarks.consistency import circle, loop, stationary, webmap
from benchmarks.gate import report
from jaxslam.results.files import versions, write_files

FOLDER = Path(__file__).parent / "results"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.consistency", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a tenth of the runs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=FOLDER)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    part = 10 if options.quick else 1
    sections, metrics, files = [], [], {}
    section, found = circle.measure(1000 // part, options.seed)
    print(section, flush=True)
    sections.append(section)
    metrics += found
    for module, scale in (
        (loop, {"maps": 100 // part}),
        (webmap, {"runs": 100 // part}),
        (stationary, {"runs": 200 // part}),
    ):
        section, found, figure = module.measure(seed=options.seed, **scale)
        print(section, flush=True)
        sections.append(section)
        metrics += found
        files[f"{section.name}.png"] = figure.savefig
    head = "\n".join(
        [
            "# Published consistency experiments, reproduced",
            "",
            f"Written by `python -m benchmarks.consistency {shlex.join(sys.argv[1:])}`".rstrip()
            + f" on {datetime.date.today().isoformat()}, float64, seed {options.seed}, "
            + ", ".join(f"{name} {number}" for name, number in versions().items())
            + f", {platform.machine()} CPU.",
            "",
        ]
    )
    files["README.md"] = head + "\n" + "\n".join(map(str, sections))
    write_files(options.out, files)
    return report(metrics)


if __name__ == "__main__":
    raise SystemExit(main())
