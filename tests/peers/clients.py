#!/usr/bin/env python3
"""Programs by others, as they were published, against the emulators of `hil-mock serve`: what each saw, and whether it is right.

    cargo build --release -p hil-mock -p usbfs-fake
    python3 -m venv target/peers && target/peers/bin/pip install 'numpy<2' pyusb natnet==0.3.0 motioncapture==1.1
    git clone https://github.com/csi-dcsc/Pycrafter6500 target/Pycrafter6500
    target/peers/bin/python tests/peers/clients.py --pycrafter target/Pycrafter6500

`natnet` (PyPI) and `motioncapture` (PyPI; libmotioncapture with the VRPN project's own library) speak over the loopback. Pycrafter6500 runs
on pyusb and the system's libusb (with or without libudev), which finds the emulated device through libusbfs_fake.so. The wheel of `hidapi` on PyPI
brings libusb 1.0.21, which reads sysfs by other names of the C library; `pip install hidapi==0.15.0` tries it as well. Whatever is
not installed is left out and said to be. The exit code is 1 when a client saw something wrong.
"""

import argparse
import importlib.util
import math
import os
import pathlib
import subprocess
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parents[2]
SECONDS = 2.0
RATE = 500
# As `hil-mock serve natnet|vrpn` is told below: a body at rest and one that stands elsewhere, in metres.
BODIES = {"Hare": (0.25, -0.5, 1.5), "Bust": (-0.125, 0.75, 2.0)}


class Server:
    """`hil-mock serve ...` for as long as the block lasts."""

    def __init__(self, program, *words):
        self.command = [program, "serve", *words]

    def __enter__(self):
        self.log = tempfile.TemporaryFile()
        self.process = subprocess.Popen(self.command, stdout=self.log, stderr=self.log)
        time.sleep(0.7)
        assert self.process.poll() is None, f"{self.command} ended at once: {self.said()}"
        return self

    def said(self):
        self.log.seek(0)
        return self.log.read().decode(errors="replace")

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait(10)


def bodies_as_words():
    return [f"--body={name}@{x},{y},{z}=still" for name, (x, y, z) in BODIES.items()]


def near(a, b):
    return math.dist(a, b) < 1e-5


# Each client runs in a process of its own: one that crashes or hangs takes nobody with it.


def natnet(multicast):
    from natnet import NatNetClient

    names, frames, wrong = {}, 0, 0
    client = NatNetClient(server_ip_address="127.0.0.1", local_ip_address="127.0.0.1", use_multicast=multicast)

    def described(descriptions):
        names.update({b.id_num: b.name for b in descriptions.rigid_bodies})

    def framed(frame):
        nonlocal frames, wrong
        frames += 1
        seen = {names.get(b.id_num): b.pos for b in frame.rigid_bodies}
        wrong += len(seen) != len(BODIES) or not all(near(seen.get(n, (9, 9, 9)), p) for n, p in BODIES.items())

    client.on_data_description_received_event.handlers.append(described)
    client.on_data_frame_received_event.handlers.append(lambda f: framed(f) if names else None)
    with client:
        client.request_modeldef()
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            client.update_sync()
            time.sleep(0.0005)
    return frames, wrong, sorted(names.values())


def motioncapture(kind):
    import motioncapture

    source = motioncapture.connect(kind, {"hostname": "127.0.0.1"})
    frames, wrong, names = 0, 0, set()
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        source.waitForNextFrame()
        seen = {name: tuple(body.position) for name, body in source.rigidBodies.items()}
        if not seen and not frames:
            continue
        frames += 1
        names |= set(seen)
        # A VRPN client learns of trackers one by one: what is there must be right.
        wrong += not all(near(seen[n], p) for n, p in BODIES.items() if n in seen)
        wrong += kind == "optitrack" and not set(BODIES) <= set(seen)
    return frames, wrong, sorted(n for n in names if n in BODIES)


def pycrafter(folder, pictures):
    import numpy

    sys.path.insert(0, folder)
    import pycrafter6500

    random = numpy.random.default_rng(3)
    images = []
    for k in range(27):
        image = numpy.zeros((1080, 1920), dtype=numpy.uint8)
        image[40 * k : 40 * k + 40, 60 * k : 60 * k + 100] = 1
        image[500:540, 900:1000] = random.integers(0, 2, (40, 100))
        images.append(image)
    dlp = pycrafter6500.dmd()
    dlp.stopsequence()
    dlp.changemode(3)
    count = len(images)
    dlp.defsequence(images, [1000000] * count, [False] * count, [0] * count, [1] * count, 0)
    dlp.startsequence()
    dlp.testread()
    dlp.testwrite()
    time.sleep(1)
    files = sorted(pathlib.Path(pictures).glob("*.pgm"))
    same = 0
    for image, file in zip(images, files):
        # "P5 1920 1080 255" and the rows.
        rows = numpy.frombuffer(file.read_bytes()[-1920 * 1080 :], dtype=numpy.uint8).reshape(1080, 1920)
        same += bool(((rows > 0) == (image > 0)).all())
    dlp.pausesequence()
    dlp.stopsequence()
    dlp.idle_on()
    time.sleep(3.1)
    dlp.idle_off()
    dlp.standby()
    dlp.wakeup()
    dlp.reset()
    return same, count - same, [f"{len(files)} patterns shown"]


def hidapi():
    """Greets the emulated DLPC900 through hidapi's libusb, twice: its firmware's version must come back as it was asked for."""
    import hid

    found = hid.enumerate(0x0451, 0xC900)
    right = wrong = 0
    for sequence, entry in enumerate(found, 7):
        device = hid.device()
        device.open_path(entry["path"])
        # Report number, flags (read, reply), sequence, length, command 0x0205.
        device.write(bytes([0, 0xC0, sequence, 2, 0, 0x05, 0x02]) + bytes(58))
        reply = device.read(64, 2000)
        good = len(reply) > 8 and reply[1] == sequence and not reply[0] & 0x20
        right, wrong = right + good, wrong + (not good)
        device.close()
    return right, wrong, [e["product_string"] or "?" for e in found]


def run(words, environment=None):
    """One client in a process of its own: (count, wrong, names), or a text that says why not."""
    command = [sys.executable, __file__, "--client", *words]
    env = {**os.environ, **(environment or {})}
    try:
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=60)
    except subprocess.TimeoutExpired:
        return "no end within 60 s"
    lines = [l for l in done.stdout.splitlines() if l.startswith("RESULT ")]
    if done.returncode or not lines:
        return f"exit code {done.returncode}: {done.stderr.strip()[-400:]}"
    count, wrong, *names = lines[-1].split()[1:]
    return int(count), int(wrong), names


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hil-mock", default=ROOT / "target/release/hil-mock", type=pathlib.Path)
    parser.add_argument("--usbfs-fake", default=ROOT / "target/release/libusbfs_fake.so", type=pathlib.Path)
    parser.add_argument("--pycrafter", type=pathlib.Path, help="folder of an unchanged Pycrafter6500")
    parser.add_argument("--versions", default="3.0,3.1,4.0,4.1,4.2", help="of NatNet, separated by commas")
    parser.add_argument("--client", nargs="+", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.client:
        kind, *more = arguments.client
        result = {"natnet": lambda: natnet(more[0] == "multicast"), "motioncapture": lambda: motioncapture(more[0]),
                  "pycrafter": lambda: pycrafter(*more), "hidapi": hidapi}[kind]()
        count, wrong, names = result
        print("RESULT", count, wrong, *(n.replace(" ", "_") for n in names), flush=True)
        # Threads of some clients never end.
        os._exit(0)

    failed = False

    def tell(client, server, result, least):
        nonlocal failed
        good = not isinstance(result, str) and result[0] >= least and result[1] == 0
        failed |= not good
        text = result if isinstance(result, str) else f"{result[0]} seen, {result[1]} wrong; {' '.join(result[2])}"
        print(f"{'ok    ' if good else 'FAILED'}  {client:24} {server:28} {text}", flush=True)

    def has(module):
        there = importlib.util.find_spec(module) is not None
        if not there:
            print(f"left out  {module}: not installed", flush=True)
        return there

    mock, half = str(arguments.hil_mock), int(SECONDS * RATE / 2)
    named = bodies_as_words()
    with_natnet, with_motioncapture = has("natnet"), has("motioncapture")
    for version in arguments.versions.split(","):
        for way in ["unicast", "multicast"] if version else []:
            words = ["natnet", "--natnet-version", version, "--rate", str(RATE), *named]
            with Server(mock, *words, *(["--multicast"] if way == "multicast" else [])):
                if with_natnet:
                    tell("natnet", f"NatNet {version} {way}", run(["natnet", way]), half)
                # It joins groups on the default route's interface, never on the loopback.
                # Version 1.1 knows the bit stream up to 4.1 and ends with a segmentation fault on 4.2's model definitions, Motive's as well.
                if with_motioncapture and way == "unicast" and version != "4.2":
                    tell("motioncapture optitrack", f"NatNet {version} {way}", run(["motioncapture", "optitrack"]), half)
    if with_motioncapture:
        with Server(mock, "vrpn", "--rate", str(RATE), *named):
            # It looks for news a few hundred times a second.
            tell("motioncapture vrpn", "VRPN", run(["motioncapture", "vrpn"]), 100)
    if has("hid"):
        port = "127.0.0.1:3248"
        with Server(mock, "dlpc900", "--usbip", port):
            library = str(arguments.usbfs_fake.resolve())
            environment = {"LD_PRELOAD": library, "USBFS_FAKE_USBIP": port, "USBFS_FAKE_DRIVER": "usbhid"}
            tell("hidapi", "DLPC900 over libusb", run(["hidapi"], environment), 1)
    if arguments.pycrafter and has("usb") and has("numpy"):
        port = "127.0.0.1:3247"
        with tempfile.TemporaryDirectory() as pictures, Server(
            mock, "dlpc900", "--usbip", port, "-v", "--dump", pictures
        ) as server:
            environment = {"LD_PRELOAD": str(arguments.usbfs_fake.resolve()), "USBFS_FAKE_USBIP": port}
            result = run(["pycrafter", str(arguments.pycrafter.resolve()), pictures], environment)
            tell("Pycrafter6500", "DLPC900 over libusb", result, 27)
            if isinstance(result, str):
                print(server.said())
    else:
        print("left out  Pycrafter6500: give its folder by --pycrafter")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
