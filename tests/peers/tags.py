#!/usr/bin/env python3
"""Corners of printed tags by dpm, OpenCV and pupil-apriltags in pictures of another painter, against the truth.

    python3 -m venv V && V/bin/pip install numpy opencv-contrib-python-headless pupil-apriltags
    cargo build --release -p dpm-camera --example corners
    V/bin/python tests/peers/tags.py [FOLDER]

Twelve scenes of two tags at 1 m are painted with twelve by twelve samples a pixel, then blurred and given noise. The table has the
root mean square of a corner's error along an axis, pixels, and the number of tags found of 24. The order of corners is that which is
nearest to the truth, and where a program counts from the centre of the first pixel half a pixel is added.
"""

import pathlib
import subprocess
import sys

import cv2
import numpy as np
from pupil_apriltags import Detector

ROOT = pathlib.Path(__file__).resolve().parents[2]
OUT = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "target/tags")
WIDTH, HEIGHT, FOCAL_PX = 640, 400, 1108.5
SAMPLES = 12
BLURS, NOISES = (0, 0.3, 0.6, 1.0), (0, 2, 5)
FAMILY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
RNG = np.random.default_rng(5)


def turned(angle, axis):
    return cv2.Rodrigues(np.array(axis, float) * angle)[0]


def cells(tag):
    """The tag with its white margin, 1 for white."""
    image = np.ones((10, 10), np.uint8)
    image[1:9, 1:9] = cv2.aruco.generateImageMarker(FAMILY, tag, 8) > 127
    return image


def paint(picture, rotation, origin, tag):
    """Paints a tag of 80 mm with cells of 10 mm; returns its corners."""
    camera = np.array([[FOCAL_PX, 0, WIDTH / 2], [0, FOCAL_PX, HEIGHT / 2], [0, 0, 1]])
    to_picture = camera @ np.array([rotation[:, 0], rotation[:, 1], origin]).T
    corners = [to_picture @ np.array([0.04 * x, 0.04 * y, 1]) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    corners = np.array([c[:2] / c[2] for c in corners])
    left, top = np.maximum(np.floor(corners.min(0) - 20), 0).astype(int)
    right, bottom = np.minimum(np.ceil(corners.max(0) + 20).astype(int), (WIDTH, HEIGHT))
    columns, rows = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
    grid, covered, light = cells(tag), np.zeros(columns.shape), np.zeros(columns.shape)
    to_tag = np.linalg.inv(to_picture)
    for a in range(SAMPLES):
        for b in range(SAMPLES):
            u = columns + (a + (b + 0.5) / SAMPLES) / SAMPLES
            v = rows + (b + (a + 0.5) / SAMPLES) / SAMPLES
            on_tag = to_tag @ np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
            cell = np.floor(on_tag[:2] / on_tag[2] / 0.01 + 5).astype(int).reshape(2, *u.shape)
            inside = ((cell >= 0) & (cell < 10)).all(0)
            at = np.clip(cell, 0, 9)
            light += np.where(inside, np.where(grid[at[1], at[0]] > 0, 180.0, 12.0), 0)
            covered += inside
    part = picture[top:bottom, left:right]
    part *= 1 - covered / SAMPLES**2
    part += light / SAMPLES**2
    return corners


def scene(k):
    """A picture without blur and noise, and the corners of its tags."""
    picture = (70 + 15 * np.arange(WIDTH)[None, :] / WIDTH + np.zeros((HEIGHT, WIDTH))).astype(np.float32)
    roll = RNG.uniform(0, 2 * np.pi) if k % 3 else 0.0
    tilt, about = RNG.uniform(0, 0.5), RNG.uniform(0, 2 * np.pi)
    place = np.array([RNG.uniform(-0.08, 0.08), RNG.uniform(-0.05, 0.05), 1.0])
    body = turned(tilt, [np.cos(about), np.sin(about), 0]) @ turned(roll, [0, 0, 1])
    truth = {}
    for side, tag in ((-1, 17 + k), (1, 401 + k)):
        origin = place + body @ np.array([side * 0.055, 0, 0])
        truth[tag] = paint(picture, body @ turned(side * -0.52, [0, 1, 0]), origin, tag)
    return picture, truth


def spoiled(picture, blur, noise):
    if blur == 0.3:
        kernel = np.array([0.045, 0.91, 0.045])
        picture = cv2.sepFilter2D(picture, -1, kernel, kernel)
    elif blur:
        picture = cv2.GaussianBlur(picture, (0, 0), blur)
    if noise:
        picture = picture + RNG.normal(0, noise, picture.shape)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def by_dpm(paths):
    program = ROOT / "target/release/examples/corners"
    text = subprocess.run([program, *paths], check=True, stdout=subprocess.PIPE, text=True).stdout
    found = {str(path): {} for path in paths}
    for line in text.splitlines():
        path, tag, *corners = line.split()
        found[path][int(tag)] = np.array(corners, float).reshape(4, 2)
    return [found[str(path)] for path in paths]


def by_opencv(refinement, offset):
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = refinement
    detector = cv2.aruco.ArucoDetector(FAMILY, parameters)

    def one(path):
        corners, tags, _ = detector.detectMarkers(cv2.imread(str(path), 0))
        return {} if tags is None else {int(t): c[0] + offset for t, c in zip(tags.ravel(), corners)}

    return lambda paths: [one(path) for path in paths]


def by_pupil(paths):
    detector = Detector(families="tag36h11", quad_decimate=1.0, refine_edges=1)
    return [{r.tag_id: np.array(r.corners) for r in detector.detect(cv2.imread(str(p), 0))} for p in paths]


PROGRAMS = {
    "dpm": by_dpm,
    "pupil-apriltags": by_pupil,
    "OpenCV, subpixel": by_opencv(cv2.aruco.CORNER_REFINE_SUBPIX, 0.5),
    "OpenCV, AprilTag": by_opencv(cv2.aruco.CORNER_REFINE_APRILTAG, 0),
}


def errors(found, truth):
    """Squared errors of the corners along an axis, of the tags that were found."""
    squares = []
    for tags, true in zip(found, truth):
        for tag in tags.keys() & true.keys():
            orders = [np.roll(c, s, 0) for c in (tags[tag], tags[tag][::-1]) for s in range(4)]
            squares.append(min((((c - true[tag]) ** 2).sum(1) / 2 for c in orders), key=np.sum))
    return squares


def main():
    OUT.mkdir(parents=True, exist_ok=True)
    scenes = [scene(k) for k in range(12)]
    truth = [true for _, true in scenes]
    print("| blur | noise | " + " | ".join(PROGRAMS) + " |\n|---|---|" + "---|" * len(PROGRAMS))
    for blur in BLURS:
        for noise in NOISES:
            paths = [OUT / f"{blur}_{noise}_{k}.pgm" for k in range(len(scenes))]
            for path, (picture, _) in zip(paths, scenes):
                cv2.imwrite(str(path), spoiled(picture, blur, noise))
            cells = []
            for program in PROGRAMS.values():
                squares = errors(program(paths), truth)
                rms = np.sqrt(np.mean(squares)) if squares else float("nan")
                cells.append(f"{rms:.3f} ({len(squares)})")
            print(f"| {blur} | {noise} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
