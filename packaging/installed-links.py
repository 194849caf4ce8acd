#!/usr/bin/env python3
"""Mends the links of documents that are installed: what a link names and the package does not contain becomes text.

    installed-links.py FOLDER [ALSO...]

FOLDER holds the documents; ALSO are folders of the package to which they may link. A link to a source file becomes the path
of the file in the sources. Ends with 1 if a link is left whose target is not there.
"""
import os
import re
import sys

LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)")


def is_there(base, target):
    return os.path.exists(os.path.join(base, target))


def mended(text, folder, root):
    """The text without links whose target is not in the package, and how many were there."""
    count = 0

    def one(match):
        nonlocal count
        image, label, target = match.groups()
        path = target.split("#")[0]
        if not path or re.match(r"[a-z]+:", target) or is_there(folder, path):
            return match.group(0)
        count += 1
        in_sources = os.path.normpath(os.path.join(os.path.relpath(folder, root), path))
        plain = label.strip("`")
        if image or plain == in_sources or os.path.basename(plain) == os.path.basename(in_sources):
            return f"`{in_sources}` of the sources"
        return f"{label} (`{in_sources}` of the sources)"

    return LINK.sub(one, text), count


def documents(root):
    for folder, _, names in os.walk(root, followlinks=False):
        for name in sorted(names):
            if name.endswith(".md"):
                yield folder, os.path.join(folder, name)


def main():
    root = sys.argv[1]
    total = 0
    for folder, path in documents(root):
        with open(path, encoding="utf-8") as file:
            text = file.read()
        text, count = mended(text, folder, root)
        total += count
        if count:
            with open(path, "w", encoding="utf-8") as file:
                file.write(text)
    left = []
    for folder, path in documents(root):
        with open(path, encoding="utf-8") as file:
            left += [f"{path}: {target}" for _, _, target in LINK.findall(file.read())
                     if not re.match(r"[a-z]+:|#", target) and not is_there(folder, target.split("#")[0])]
    print(f"links of installed documents: {total} to what is not installed became text", file=sys.stderr)
    if left:
        sys.exit("dead links are left:\n" + "\n".join(left))


main()
