#!/usr/bin/env python3
"""Watches a running rig through its page, and says when the state of its light changes.

    dpm run rig.toml --page &
    python3 examples/page-client.py [ADDRESS] [SECONDS]

Needs nothing but Python. To give orders, a client signs them: docs/PAGE.md, "Signatures".
"""
import json
import sys
import time
import urllib.request

ADDRESS = sys.argv[1] if len(sys.argv) > 1 else "127.0.0.1:8947"
SECONDS = float(sys.argv[2]) if len(sys.argv) > 2 else float("inf")


def state():
    with urllib.request.urlopen(f"http://{ADDRESS}/api/state", timeout=2) as answer:
        return json.load(answer)


def main():
    before, end = None, time.monotonic() + SECONDS
    while time.monotonic() < end:
        light = state()["now"]["light"]
        word = light["word"]
        if word != before:
            print(f"{time.strftime('%H:%M:%S')} {word}", light.get("told") or "", flush=True)
            before = word
        time.sleep(0.5)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        pass
    except OSError as error:
        sys.exit(f"no rig's page at {ADDRESS}: {error}; start one with dpm run RIG.toml --page")
