"""One of several parts of the exhaustive lane, whose result is kept in the repository.

usage: python -m tests.shard K/N [-- OPTIONS OF PYTEST]

Files of tests are dealt out to N shards of about equal processor time, by `durations.json`; a file stays in
one piece, since its tests share compiled programs. The result goes to `exhaustive.json`: commit, date,
numbers of passed and failed tests, names of these, seconds; and to the table in CONTRIBUTING.md.
"""

import argparse
import json
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path
from xml.etree import ElementTree

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parent
sys.path.insert(0, str(FOLDER))

import lanes  # noqa: E402


def tests_of_lane() -> list[str]:
    """Names of the exhaustive tests, as pytest collects them."""
    command = [sys.executable, "-m", "pytest", "-n", "0", "-m", "exhaustive", "--collect-only", "-q"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if run.returncode != 0:
        raise SystemExit(f"pytest could not collect the exhaustive tests:\n{run.stdout}{run.stderr}")
    return [line for line in run.stdout.splitlines() if "::" in line]


def shards(tests: list[str], seconds: dict[str, float], count: int) -> list[list[str]]:
    """Tests by shard: files in falling order of their time, each to the shard that has least."""
    files = defaultdict(list)
    for test in tests:
        files[test.partition("::")[0]].append(test)
    times = {file: sum(seconds.get(test, lanes.UNMEASURED) for test in files[file]) for file in files}
    dealt: list[list[str]] = [[] for _ in range(count)]
    loads = [0.0] * count
    for file in sorted(files, key=lambda file: (-times[file], file)):
        lightest = loads.index(min(loads))
        loads[lightest] += times[file]
        dealt[lightest] += files[file]
    return dealt


def run_shard(tests: list[str], options: list[str]) -> dict:
    """Run tests, and say how they ended."""
    report = ROOT / ".pytest_cache" / "shard.xml"
    report.parent.mkdir(exist_ok=True)
    report.unlink(missing_ok=True)
    git = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True).stdout.strip()
    begun = time.time()
    command = [sys.executable, "-m", "pytest", "-m", "exhaustive", f"--junitxml={report}", *options, *tests]
    status = subprocess.run(command, cwd=ROOT).returncode
    if not report.exists():
        raise SystemExit(f"pytest ended with status {status} and without a report")
    cases = list(ElementTree.parse(report).getroot().iter("testcase"))
    failed = [case for case in cases if any(end.tag in ("failure", "error") for end in case)]
    skipped = [case for case in cases if any(end.tag == "skipped" for end in case)]
    return {
        "commit": commit,
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "tests": len(tests),
        "passed": len(cases) - len(failed) - len(skipped),
        "failed": sorted(f"{case.get('classname')}::{case.get('name')}" for case in failed),
        "seconds": round(time.time() - begun),
    }


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("shard", metavar="K/N", help="which one, from 1, of how many")
    parser.add_argument("options", nargs="*", help="of pytest, after --")
    arguments = parser.parse_args()
    results = json.loads(lanes.EXHAUSTIVE.read_text()) if lanes.EXHAUSTIVE.exists() else {}
    part, _, count = arguments.shard.partition("/")
    if not (part.isdigit() and count.isdigit() and 1 <= int(part) <= int(count)):
        parser.error("say which shard, as 2/8")
    seconds = lanes.seconds_by_lane().get("exhaustive", {})
    tests = shards(tests_of_lane(), seconds, int(count))[int(part) - 1]
    if not tests:
        raise SystemExit(f"shard {arguments.shard} has no tests")
    results[arguments.shard] = run_shard(tests, arguments.options)
    lanes.EXHAUSTIVE.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n")
    lanes.write()
    sys.exit(1 if results[arguments.shard]["failed"] else 0)


if __name__ == "__main__":
    main()
