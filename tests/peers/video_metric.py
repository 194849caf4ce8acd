#!/usr/bin/env python3
"""Does `dpm error` rank methods as a video metric of others does? ColorVideoVDP [Mantiuk24] on the same frames, and the agreement of the ranks.

    dpm error RIG.toml --quick --sequences --out DIR
    pip install cvvdp                                  # and what it needs: torch, CPU is enough
    tests/peers/video_metric.py DIR [--peak 200] [--before truth] [--frames 237] [--window 1] [--methods full,paper] [--json FILE]

Reads DIR/sequences/*/sequence.json. Every sequence is shown at the rig's own frame rate and angular size; white is --peak cd/m^2. Prints for
each group the perceived RMSE of `dpm error` beside the JOD (10 is the reference itself, less is worse), Kendall's tau-b of the two orders,
and how many of the pairs of methods that differ clearly in JOD (by 0.1 or more) both put in one order. --window 31 shows the metric the mean of
every 31 frames in place of each, as the eye of `dpm error` has it: whether the metric minds what changes faster.

--before: what is taken for the time before the sequence, for the metric's filters are as long as 250 ms. `truth`: the reference's first frame,
the lead-in that `dpm error` writes. `mirror`: the sequence backwards, by the metric itself. `first`: the method's own first frame, as if it had
stood there all the time: the metric's way with a file that has no lead-in.
"""
import argparse
import itertools
import json
import pathlib

import numpy as np


def read_pfm(path):
    data = path.read_bytes()
    kind, size, scale, body = data.split(b"\n", 3)
    width, height = map(int, size.split())
    assert kind == b"PF" and float(scale) == -1.0, path
    return np.frombuffer(body, "<f4", width * height * 3).reshape(height, width, 3)[::-1]


def read_sequence(folder, lead_in, frames, window=1):
    """The mean of every `window` of the last frames, without the lead-in."""
    paths = sorted(folder.glob("*.pfm"))[lead_in:][-(frames + window - 1):]
    all_frames = np.stack([read_pfm(p) for p in paths]).astype(np.float64)
    sums = np.cumsum(np.concatenate([np.zeros_like(all_frames[:1]), all_frames]), axis=0)
    return (sums[window:] - sums[:-window]) / window


def kendall(a, b):
    score = lambda x: [np.sign(x[i] - x[k]) for i, k in itertools.combinations(range(len(x)), 2)]
    s, t = np.array(score(a)), np.array(score(b))
    return float((s * t).sum() / np.sqrt((s * s).sum() * (t * t).sum()))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dir", type=pathlib.Path)
    parser.add_argument("--peak", type=float, default=200.0)
    parser.add_argument("--before", choices=["truth", "mirror", "first"], default="truth")
    parser.add_argument("--frames", type=int, default=10_000, help="only the last so many")
    parser.add_argument("--window", type=int, default=1, help="each frame the mean of so many")
    parser.add_argument("--methods", type=lambda text: text.split(","), help="only these")
    parser.add_argument("--json", type=pathlib.Path)
    args = parser.parse_args()

    import pycvvdp
    import torch

    torch.set_num_threads(2)
    groups, all_pairs, same_pairs = [], 0, 0
    for path in sorted(args.dir.glob("sequences/*/sequence.json")):
        index = json.loads(path.read_text())
        width, height = index["raster"]
        photometry = pycvvdp.vvdp_display_photo_eotf(
            Y_peak=10 * args.peak, contrast=1_000_000, source_colorspace="BT.709-linear", E_ambient=0)
        geometry = pycvvdp.vvdp_display_geometry([width, height], ppd=index["pixels_per_degree"])
        metric = pycvvdp.cvvdp(
            display_photometry=photometry, display_geometry=geometry, device=torch.device("cpu"), quiet=True,
            temp_padding="symmetric" if args.before == "mirror" else "replicate")
        show = lambda folder: np.ascontiguousarray(
            read_sequence(path.parent / folder, index.get("lead_in", 0), args.frames, args.window)
            * (args.peak / index["white"]) + 0.2).astype(np.float32)
        reference = show(index["reference"])
        before = reference[: 1 if args.before == "truth" else 0]
        reference = np.concatenate([before, reference])
        rows = []
        for method in (m for m in index["methods"] if not args.methods or m["method"] in args.methods):
            jod, _ = metric.predict(
                np.concatenate([before, show(method["folder"])]), reference, dim_order="FHWC", frames_per_second=index["frame_rate_hz"])
            rows.append({"method": method["method"], "perceived_rmse": method["perceived_rmse"], "jod": float(jod)})
        pairs = [(a, b) for a, b in itertools.combinations(rows, 2) if abs(a["jod"] - b["jod"]) >= 0.1]
        same = [(a, b) for a, b in pairs if (a["jod"] - b["jod"]) * (a["perceived_rmse"] - b["perceived_rmse"]) < 0]
        all_pairs, same_pairs = all_pairs + len(pairs), same_pairs + len(same)
        tau = kendall([-r["perceived_rmse"] for r in rows], [r["jod"] for r in rows])
        groups.append({"group": index["group"], "rows": rows, "tau": tau, "clear_pairs": len(pairs), "same": len(same)})
        print(f"{index['group']}: tau {tau:+.2f}, {len(same)} of {len(pairs)} clear pairs in one order, "
              f"{index['pixels_per_degree']:.1f} pixels a degree")
        for row in sorted(rows, key=lambda r: r["perceived_rmse"]):
            print(f"  {row['method']:26} perceived RMSE {row['perceived_rmse']:.5f}  JOD {row['jod']:.3f}")
    print(f"all groups: {same_pairs} of {all_pairs} clear pairs in one order")
    if args.json:
        args.json.write_text(json.dumps(groups, indent=1))


if __name__ == "__main__":
    main()
