#!/usr/bin/env python3
"""libzmq and msgpack for Python, as they are published, at both ends of Pupil's network interface.

    cargo build --release -p hil-mock -p dpm
    python3 -m venv target/peers && target/peers/bin/pip install pyzmq msgpack
    target/peers/bin/python tests/peers/pupil.py

First a program as others write it hears `hil-mock serve pupil`. Then `dpm doctor` hears a Pupil that is made of libzmq and msgpack
here, with the keys that Pupil Capture 2 and 3 send. The exit code is 1 when an end has seen something wrong.
"""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile
import threading
import time

import msgpack
import zmq

ROOT = pathlib.Path(__file__).resolve().parents[2]
PORT = 50023
SECONDS = 2.0


def ask(remote, words):
    remote.send_string(words)
    return remote.recv_string()


def hear_the_mock(program):
    server = subprocess.Popen([program, "serve", "pupil", "--port", str(PORT), "--clock-offset-s", "777", "--seconds", "30"],
                              stdout=subprocess.DEVNULL)
    try:
        time.sleep(0.5)
        context = zmq.Context()
        remote, data = context.socket(zmq.REQ), context.socket(zmq.SUB)
        for socket in (remote, data):
            socket.setsockopt(zmq.RCVTIMEO, 3000)
            # libzmq sends PING then, which version 3.0 does not have: the other end has to bear it.
            socket.setsockopt(zmq.HEARTBEAT_IVL, 200)
        remote.connect(f"tcp://127.0.0.1:{PORT}")
        data.connect(f"tcp://127.0.0.1:{ask(remote, 'SUB_PORT')}")
        data.subscribe("gaze.3d.")
        before = float(ask(remote, "t"))
        begin, count, wrong = time.monotonic(), 0, 0
        while time.monotonic() - begin < SECONDS:
            topic, payload = data.recv_multipart()
            sample = msgpack.loads(payload, raw=False, strict_map_key=False)
            count += 1
            eyes, normals, point = sample["eye_centers_3d"], sample["gaze_normals_3d"], sample["gaze_point_3d"]
            for eye in (0, 1):
                # Each line of sight passes through the point.
                line = [p - c for p, c in zip(point, eyes[eye])]
                length = sum(x * x for x in line) ** 0.5
                wrong += any(abs(x / length - n) > 1e-9 for x, n in zip(line, normals[eye]))
            wrong += topic != b"gaze.3d.01." or sample["topic"] != "gaze.3d.01." or not 0 < sample["confidence"] < 1
        after = float(ask(remote, "t"))
        wrong += not (before - 0.1 < sample["timestamp"] <= after)
        wrong += ask(remote, "T 12.5") != "Timesync successful." or abs(float(ask(remote, "t")) - 12.5) > 0.1
        wrong += ask(remote, "nonsense") != "Unknown command."
        good = wrong == 0 and count > 150 * SECONDS
        print(f"libzmq {zmq.zmq_version()} against hil-mock: {count} samples, {wrong} wrong, {'good' if good else 'BAD'}")
        context.destroy(0)
        return good
    finally:
        server.terminate()
        server.wait(10)


class Pupil(threading.Thread):
    """Pupil Remote and its data by libzmq. The keys of both eyes are numbers, as of Pupil Capture 2, or texts."""

    def __init__(self, are_texts):
        super().__init__(daemon=True)
        self.are_texts, self.over = are_texts, False
        context = zmq.Context.instance()
        self.remote, self.data = context.socket(zmq.REP), context.socket(zmq.PUB)
        self.port = self.remote.bind_to_random_port("tcp://127.0.0.1")
        self.data_port = self.data.bind_to_random_port("tcp://127.0.0.1")
        self.start()

    def run(self):
        clock = lambda: time.monotonic() + 4e6
        due = time.monotonic()
        while not self.over:
            if self.remote.poll(2):
                words = self.remote.recv_string()
                self.remote.send_string({"SUB_PORT": str(self.data_port), "t": str(clock())}.get(words, "Unknown command."))
            if time.monotonic() >= due:
                due += 1 / 120
                name = str if self.are_texts else int
                pupil = {"topic": "pupil.0.3d", "confidence": 0.9, "timestamp": clock(), "ellipse": {"center": (1.5, 2.5), "angle": -3}}
                sample = {
                    "topic": "gaze.3d.01.", "norm_pos": (0.5, 0.5), "confidence": 0.9, "timestamp": clock(),
                    "eye_centers_3d": {name(0): [20.0, 15.0, -20.0], name(1): [-40.0, 15.0, -20.0]},
                    "gaze_normals_3d": {name(0): [0.0, 0.0, 1.0], name(1): [0.0, 0.0, 1.0]},
                    "gaze_point_3d": [-10.0, 15.0, 600.0], "base_data": [pupil, pupil],
                }
                self.data.send_string("gaze.3d.01.", flags=zmq.SNDMORE)
                self.data.send(msgpack.dumps(sample, use_bin_type=True))
        self.remote.close(0)
        self.data.close(0)


def be_heard(program, are_texts):
    pupil = Pupil(are_texts)
    with tempfile.TemporaryDirectory() as folder:
        rig = pathlib.Path(folder) / "rig.toml"
        rig.write_text(f'[observer]\ntracked = "glasses"\n[observer.gaze]\nkind = "pupil"\nport = {pupil.port}\n')
        done = subprocess.run([program, "doctor", rig, "--json"], capture_output=True, text=True, timeout=120)
    pupil.over = True
    pupil.join()
    found = [f for f in json.loads(done.stdout)["findings"] if f["name"] == "gaze"]
    good = len(found) == 1 and found[0]["state"] == "ok"
    print(f"dpm doctor against libzmq, eyes named by {'texts' if are_texts else 'numbers'}: {found}, {'good' if good else 'BAD'}")
    return good


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--programs", type=pathlib.Path, default=ROOT / "target/release")
    args = parser.parse_args()
    good = [hear_the_mock(args.programs / "hil-mock"), *(be_heard(args.programs / "dpm", texts) for texts in (False, True))]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
