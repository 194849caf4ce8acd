#!/usr/bin/env python3
"""Tiers of tests: what `./x test` asks, and what it prints and records of a run.

    tests/tiers/tiers.py select NAME...          arguments of cargo-nextest for one crate, file or test
    tests/tiers/tiers.py draw COMMIT SECONDS     the share of the second tier that a commit draws, as a filter of cargo-nextest
    tests/tiers/tiers.py table COSTS [--record] [--passed COMMIT]
                                                 what a run cost beside what is recorded; writes tests/costs.tsv or tests/all.passed
    tests/tiers/tiers.py behind                  how much has changed since the last full pass

A unit is what is recorded and drawn: the unit tests of one crate, or one file of its integration tests. COSTS has a line a
test, as tests/meter writes it.
"""
import argparse
import datetime
import hashlib
import pathlib
import re
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parents[2]
COSTS = ROOT / "tests/costs.tsv"
PASSED = ROOT / "tests/all.passed"
# A module of this name above a test puts it into the second tier.
SECOND_TIER = ("breadth", "real_pace")
# Share by which the same tests cost more or less from run to run.
NOISE = 0.25
# Changes here weigh most: what decides about light, and what draws it.
WATCHED = ("device", "host/rig/src/engine", "shaders")


def tier_of(test):
    return next((part for part in test.split("::")[:-1] if part in SECOND_TIER), "commit")


def unit_of(binary, test):
    """The unit and the tier of a test. An integration test belongs to its file, a unit test to its crate."""
    tier = tier_of(test)
    if not binary.endswith("::laws"):
        return binary, tier
    parts = [part for part in test.split("::")[:-1] if part not in SECOND_TIER]
    return (f"{binary}::{parts[0]}" if parts else binary), tier


def read_costs(path):
    """{(unit, tier): [tests, core-seconds, failed]} of the lines that tests/meter wrote."""
    units = {}
    for line in pathlib.Path(path).read_text().splitlines():
        binary, test, core_s, _, code = line.split("\t")
        unit = units.setdefault(unit_of(binary, test), [0, 0.0, 0])
        unit[0] += 1
        unit[1] += float(core_s)
        unit[2] += code != "0"
    return units


def recorded():
    """{(unit, tier): (tests, core-seconds)} of tests/costs.tsv."""
    if not COSTS.exists():
        return {}
    rows = [line.split("\t") for line in COSTS.read_text().splitlines() if line and not line.startswith("#")]
    return {(unit, tier): (int(tests), float(core_s)) for unit, tier, tests, core_s in rows}


def git(*words):
    return subprocess.run(["git", *words], cwd=ROOT, text=True, capture_output=True)


def select(names):
    """Arguments of cargo-nextest: the packages to build, and a filter. A file or a module is run whole, of both tiers."""
    packages, filters, whole = set(), [], False
    manifests = {}
    for manifest in ROOT.glob("**/Cargo.toml"):
        if any(part in ("target", "fuzz", "out") for part in manifest.relative_to(ROOT).parts):
            continue
        found = re.search(r'^\[package\]\nname = "([^"]+)"', manifest.read_text(), re.M)
        if found:
            manifests[found[1]] = manifest.parent
    for name in names:
        if name in manifests:
            packages.add(name)
            filters.append(f"package(={name})")
            continue
        files = [ROOT / name] if (ROOT / name).is_file() else sorted(
            path for folder in manifests.values() for kind in ("tests/laws", "src") for path in (folder / kind).rglob("*")
            if path.stem == name and (path.suffix == ".rs" or path.is_dir()))
        if not files:
            sys.exit(f"./x test: {name} is no crate, no file of tests and no module; cargo nextest run --workspace {name} looks for a test of that name")
        for file in files:
            # The innermost crate: tests/ holds crates below itself.
            package = max((p for p in manifests if manifests[p] in file.parents), key=lambda p: len(manifests[p].parts))
            below = file.relative_to(manifests[package]).with_suffix("").parts
            parts = list(below[2:] if below[:2] == ("tests", "laws") else below[1:])
            if parts and parts[-1] in ("mod", "lib", "main"):
                parts.pop()
            kind = "binary(=laws)" if below[0] == "tests" else "not binary(=laws)"
            module = "::".join(parts)
            packages.add(package)
            filters.append(f"(package(={package}) & {kind}" + (f" & test(/^{module}::/))" if module else ")"))
            whole = True
    words = [word for package in sorted(packages) for word in ("-p", package)]
    if "dpm-device" in packages:
        # Its tests need its standard library, which the crates that use it switch on. The firmware builds without.
        words += ["--features", ",".join(f"dpm-device/{name}" for name in ("std", "usb", "serial", "net"))]
    words += ["-E", f"not binary(vkms) & ({' | '.join(filters)})"]
    print("\n".join(words + (["--ignore-default-filter"] if whole else [])))


def draw(commit, seconds):
    """Units of the second tier that need no real pace, in an order that the commit's hash decides, while they fit."""
    rows = [(unit, cost) for (unit, tier), (_, cost) in recorded().items() if tier == "breadth"]
    rows.sort(key=lambda row: hashlib.sha256(f"{commit} {row[0]}".encode()).digest())
    chosen, left = [], seconds
    for unit, cost in rows:
        if cost <= left:
            left -= cost
            chosen.append(unit)
    print(f"Of the second tier, {commit[:12]} draws {', '.join(chosen) or 'nothing'} ({seconds - left:.0f} core-seconds).", file=sys.stderr)
    filters = []
    for unit in chosen:
        crate, _, module = unit.partition("::laws::")
        name = crate.split("::")[0]
        of_file = f"binary(=laws) & test(/^(breadth::{module}|{module}::breadth)::/)" if module else "not binary(=laws) & test(/(^|::)breadth::/)"
        filters.append(f"(package(={name}) & {of_file})")
    print(" | ".join(filters) or "none()")


def steady(was, tests, cost):
    """What is recorded of a unit that cost `cost` core-seconds. The same tests cost a quarter more or less from run to
    run, by what else the host of the machine does: such a difference changes no record."""
    return was[1] if was and was[0] == tests and abs(cost - was[1]) <= NOISE * was[1] else cost


def table(path, record, passed):
    units, known = read_costs(path), recorded()
    lines = [f"{'program':<44} {'tier':<9} {'tests':>5} {'core-s':>7} {'recorded':>8}"]
    for (unit, tier), (tests, core_s, failed) in sorted(units.items(), key=lambda row: (row[0][1] != "commit", row[0][1], row[0][0])):
        was = known.get((unit, tier))
        note = f"  {failed} FAILED" if failed else ""
        lines.append(f"{unit:<44} {tier:<9} {tests:>5} {core_s:>7.1f} {f'{was[1]:.1f}' if was else '-':>8}{note}")
    for tier in ("commit", *SECOND_TIER):
        rows = [row for (_, t), row in units.items() if t == tier]
        if rows:
            was = sum(cost for (_, t), (_, cost) in known.items() if t == tier)
            lines.append(f"{'all':<44} {tier:<9} {sum(r[0] for r in rows):>5} {sum(r[1] for r in rows):>7.1f} {was:>8.1f}")
    print("\n".join(lines))
    if record:
        fresh = {key: (tests, steady(known.get(key), tests, cost)) for key, (tests, cost, _) in units.items()}
        # What this run did not run keeps its record, if its tier was not run at all.
        tiers = {tier for _, tier in fresh}
        kept = {key: row for key, row in known.items() if key[1] not in tiers}
        rows = sorted({**kept, **fresh}.items(), key=lambda row: (row[0][1], row[0][0]))
        COSTS.write_text("# Written by `./x test --record`: unit, tier, tests, core-seconds. A test refuses a commit tier over 430 core-seconds.\n"
                         + "".join(f"{unit}\t{tier}\t{tests}\t{cost:.2f}\n" for (unit, tier), (tests, cost) in rows))
    if passed:
        date = datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d")
        PASSED.write_text(f"commit {passed}\ndate {date}\n\n" + "\n".join(lines) + "\n")


def behind():
    text = PASSED.read_text() if PASSED.exists() else ""
    found = re.match(r"commit ([0-9a-f]{40})\ndate (\S+)", text)
    if not found:
        print("No full pass is recorded (tests/all.passed): run ./x test --all.")
        return
    commit, date = found[1], found[2]
    count = git("rev-list", "--count", f"{commit}..HEAD")
    if count.returncode:
        print(f"The last full pass was {commit[:12]} on {date}; this clone has not that commit.")
        return
    print(f"{count.stdout.strip()} commits lie behind the last full pass ({commit[:12]}, {date}).")
    for folder in WATCHED:
        changed = git("diff", "--shortstat", commit, "HEAD", "--", folder).stdout.strip()
        print(f"  {folder}: {changed or 'unchanged'}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sub = parser.add_subparsers(dest="command", required=True)
    sub.add_parser("select").add_argument("names", nargs="+")
    share = sub.add_parser("draw")
    share.add_argument("commit")
    share.add_argument("seconds", type=float)
    costs = sub.add_parser("table")
    costs.add_argument("costs")
    costs.add_argument("--record", action="store_true")
    costs.add_argument("--passed")
    sub.add_parser("behind")
    args = parser.parse_args()
    if args.command == "select":
        select(args.names)
    elif args.command == "draw":
        draw(args.commit, args.seconds)
    elif args.command == "table":
        table(args.costs, args.record, args.passed)
    else:
        behind()


if __name__ == "__main__":
    main()
