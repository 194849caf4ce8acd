#!/usr/bin/env python3
"""Writes THIRD-PARTY.md: every package in Cargo.lock with its licence, and what binaries must carry.

    python3 packaging/third-party.py

Run it after every change of Cargo.lock; `./x test third_party` fails until it was.
"""

import json
import pathlib
import subprocess

ROOT = pathlib.Path(__file__).resolve().parents[1]
LINUX = "x86_64-unknown-linux-gnu"
PROGRAMS = {"dpm": "dpm", "hil-mock": "hil-mock"}

HEAD = """# Third-party software

Made by `packaging/third-party.py` from `cargo metadata`; do not edit. The programs `dpm` and `hil-mock` contain the packages that the column
"in" names; the others build them, test them, or belong to other systems. The texts of the licences lie in the packages
(`cargo vendor` fetches all of them).

## Libraries whose licence asks for more than a notice

**libusb** {libusb} ({libusb_where}), LGPL-2.1-or-later, Copyright of its authors (file `AUTHORS` of its source). It is linked into `dpm`
statically by default, so that a bare machine with gcc builds the program. Whoever passes a binary on must let its users replace libusb. They
can, in either of two ways:

* Link the system's libusb dynamically: install its development files (`libusb-1.0-0-dev` on Debian) and `pkg-config`, then
  `cargo build --release -p dpm --no-default-features --features satellites,terminal,exr,wayland,x11`. `ldd target/release/dpm` then shows `libusb-1.0.so.0`.
  Binaries that are passed on without their source should be built so.
* Relink the static one: the source of this program is complete, `Cargo.lock` fixes every version, and
  `cargo build --release` compiles libusb from the source in the package `libusb1-sys` (folder `libusb/`), which may be changed
  (`[patch.crates-io]`). The object files that are linked lie in `target/release/build/libusb1-sys-*/out/`.

**serialport** {serialport}, MPL-2.0: used unchanged; its source is the package of this version on crates.io. Whoever changes its files passes
the changed files on under the MPL-2.0.

Neither is needed by the wire formats: `dpm-device` without its features `usb` and `serial` contains none of the two.

## All packages

| package | version | licence | in | source |
|---|---|---|---|---|
"""


def metadata(*words):
    command = ["cargo", "metadata", "--locked", "--format-version", "1", *words]
    return json.loads(subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout)


def linked(linux, name):
    """Names and versions of what the package `name` contains when it is built on Linux."""
    nodes = {n["id"]: n for n in linux["resolve"]["nodes"]}
    packages = {p["id"]: p for p in linux["packages"]}
    macros = {i for i, p in packages.items() if any("proc-macro" in t["kind"] for t in p["targets"])}
    waiting = [i for i, p in packages.items() if p["name"] == name and p["source"] is None]
    seen = set()
    while waiting:
        package = waiting.pop()
        if package in seen or package in macros:
            continue
        seen.add(package)
        for d in nodes[package]["deps"]:
            if any(k["kind"] is None for k in d["dep_kinds"]):
                waiting.append(d["pkg"])
    return {(packages[i]["name"], packages[i]["version"]) for i in seen}


def libusb_version(package):
    header = pathlib.Path(package["manifest_path"]).parent / "libusb" / "libusb" / "version.h"
    words = dict(line.split()[1:3] for line in header.read_text().splitlines() if line.startswith("#define LIBUSB_M"))
    return ".".join(words["LIBUSB_" + w] for w in ("MAJOR", "MINOR", "MICRO"))


def main():
    everything = metadata("--all-features")
    linux = metadata("--filter-platform", LINUX)
    contents = {program: linked(linux, name) for program, name in PROGRAMS.items()}
    foreign = sorted((p for p in everything["packages"] if p["source"]), key=lambda p: (p["name"], p["version"]))
    by_name = {p["name"]: p for p in foreign}
    sys = by_name["libusb1-sys"]
    text = HEAD.format(
        libusb=libusb_version(sys),
        libusb_where=f"in the package libusb1-sys {sys['version']}",
        serialport=by_name["serialport"]["version"],
    )
    for p in foreign:
        key = (p["name"], p["version"])
        where = ", ".join(program for program, names in contents.items() if key in names) or "–"
        licence = p["license"] or f"see {p['license_file']}"
        source = p["repository"] or p["homepage"] or f"crates.io: {p['name']}"
        text += f"| {p['name']} | {p['version']} | {' '.join(licence.replace('/', ' OR ').split())} | {where} | {source} |\n"
    (ROOT / "THIRD-PARTY.md").write_text(text)
    print(f"{len(foreign)} packages")


if __name__ == "__main__":
    main()
