#!/usr/bin/env python3
"""Prints the licence texts of all packages of others that a program of this workspace contains, for those who get it as a binary.

    python3 packaging/licences.py

A text that several packages share is printed once, with the names of all of them. A package without a text of its own is
listed with the name of its licence.
"""

import importlib.util
import pathlib
import sys

HERE = pathlib.Path(__file__).resolve().parent
NAMES = ("LICENSE", "LICENCE", "COPYING", "COPYRIGHT", "NOTICE", "UNLICENSE")


def third_party():
    spec = importlib.util.spec_from_file_location("third_party", HERE / "third-party.py")
    module = importlib.util.module_from_spec(spec)
    sys.dont_write_bytecode = True
    spec.loader.exec_module(module)
    return module


def texts(package):
    """The licence files in the top folder of a package."""
    folder = pathlib.Path(package["manifest_path"]).parent
    files = sorted(f for f in folder.iterdir() if f.is_file() and f.name.upper().startswith(NAMES))
    return [f.read_text(encoding="utf-8", errors="replace").replace("\r\n", "\n").strip() for f in files]


def main():
    listing = third_party()
    linux = listing.metadata("--filter-platform", listing.LINUX)
    contained = set().union(*(listing.linked(linux, name) for name in listing.PROGRAMS.values()))
    packages = [p for p in linux["packages"] if p["source"] and (p["name"], p["version"]) in contained]
    users, bare = {}, []
    for package in sorted(packages, key=lambda p: (p["name"], p["version"])):
        title = f"{package['name']} {package['version']} ({package['license']})"
        found = texts(package)
        for text in found:
            users.setdefault(text, []).append(title)
        if not found:
            bare.append(f"{title}, {package['repository']}")
    if len(packages) < 50 or len(users) < 10:
        sys.exit("licences.py: the packages were not understood, or their sources are not here (cargo fetch)")
    print("Software by others that the programs contain, with its licences.\n")
    for text, names in users.items():
        print("=" * 100, *names, "-" * 100, text, "", sep="\n")
    print("=" * 100, "Packages whose sources hold no text of their licence:", *bare, sep="\n")


if __name__ == "__main__":
    main()
