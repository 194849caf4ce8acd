#!/usr/bin/env python3
"""Writes one projector in sixteen dialects of calibration files, and the pixels to which OpenCV itself takes points.

    python3 -m venv V && V/bin/pip install opencv-python-headless numpy pyyaml
    V/bin/python tests/peers/calibrations.py

`tests/assets/dialects/` has what it writes: the files, `dialects.tsv` with what a person says of each (unit, device, frame)
and what is right of it, and `pixels.csv` with world points [m] and their pixels by cv2.projectPoints (OpenCV's, with the
centres of pixels at whole numbers): with the lens of all files, and without a lens for MPCDI, which has none. Nothing is
random. The test `dialects_project_as_opencv_does` of `dpm-scene` holds the readers to them.
"""

import gzip
import json
import pathlib
import zipfile

import cv2
import numpy as np
import yaml

OUT = pathlib.Path(__file__).resolve().parents[1] / "assets/dialects"
SIZE = (1024, 768)
K = np.array([[1480.0, 0, 508.5], [0, 1510.0, 702.25], [0, 0, 1]])
# Brown's model in full: radial, tangential and k3.
LENS = np.array([-0.08, 0.05, 0.002, -0.003, -0.02])
# Another device of the same file, so that what is read by chance is seen.
CAMERA = np.array([[900.0, 0, 327], [0, 905.0, 235], [0, 0, 1]])
CAMERA_LENS = np.array([-0.11, 0.17, 0.0001, 0.003, 0.0])


def pose():
    """World into OpenCV's axes of the projector: turned about all axes, which no transposed matrix survives."""
    position = np.array([0.35, 0.55, 1.3])
    forward = np.array([0.02, 0.28, 0.0]) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.08, 1.0, 0.03])
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(forward, right), forward])
    return rotation, -rotation @ position


R, T = pose()
RVEC = cv2.Rodrigues(R)[0]
POSE = np.vstack([np.column_stack([R, T]), [0, 0, 0, 1]])


def storage(name, fill):
    """A file by cv2.FileStorage."""
    file = cv2.FileStorage(str(OUT / name), cv2.FILE_STORAGE_WRITE)
    fill(file)
    file.release()


def flat(file, names=("K", "dist", "R", "T"), size=True, scale=1.0):
    if size:
        file.write("image_width", SIZE[0])
        file.write("image_height", SIZE[1])
    for name, value in zip(names, (K, LENS.reshape(1, -1), R, scale * T.reshape(3, 1))):
        file.write(name, value)


def section(file, name, matrix, lens, rotation, translation, size):
    file.startWriteStruct(name, cv2.FileNode_MAP)
    file.write("imageWidth", size[0])
    file.write("imageHeight", size[1])
    file.write("responseGamma", 2.2)
    file.write("cameraMatrix", matrix)
    file.write("distortionCoeffs", lens.reshape(1, -1))
    file.write("avgReprojErr", 0.3)
    file.write("R", rotation)
    file.write("T", translation.reshape(3, 1))
    file.endWriteStruct()


def procamcalib(file):
    """Its sections have blanks in their names."""
    file.startWriteStruct("Cameras", cv2.FileNode_SEQ)
    file.write("", "Camera  0")
    file.endWriteStruct()
    file.startWriteStruct("Projectors", cv2.FileNode_SEQ)
    file.write("", "Projector  0")
    file.endWriteStruct()
    section(file, "Camera  0", CAMERA, CAMERA_LENS, np.eye(3), np.zeros(3), (640, 480))
    section(file, "Projector  0", K, LENS, R, 1000 * T, SIZE)


def two_devices(names, scale, file):
    """Camera and projector beside each other: names of K, lens of both, and of the pose between them."""
    values = (CAMERA, CAMERA_LENS.reshape(-1, 1), K, LENS.reshape(-1, 1), R, scale * T.reshape(3, 1))
    for name, value in zip(names, values):
        file.write(name, value)


def nested(file):
    file.startWriteStruct("projector", cv2.FileNode_MAP)
    flat(file, ("camera_matrix", "distortion_coefficients", "rotation", "translation"), size=False)
    file.startWriteStruct("image_size", cv2.FileNode_SEQ)
    file.write("", SIZE[0])
    file.write("", SIZE[1])
    file.endWriteStruct()
    file.endWriteStruct()


def mapamok(file):
    """All of its entries: lists of cv::Size and cv::Point2d, and the rotation three times."""
    file.write("cameraMatrix", K)
    file.write("focalLength", 16.0)
    for name, values in (("fov", (38.2, 28.4)), ("principalPoint", (0.1, 0.2)), ("imageSize", SIZE)):
        file.startWriteStruct(name, cv2.FileNode_SEQ)
        for value in values:
            file.write("", value)
        file.endWriteStruct()
    file.write("distortionCoefficients", LENS.reshape(1, -1))
    file.write("translationVector", T.reshape(3, 1))
    file.write("rotationVector", RVEC)
    file.write("rotationMatrix", R)
    file.write("rotationAngleRadians", float(np.linalg.norm(RVEC)))
    file.write("rotationAxis", RVEC / np.linalg.norm(RVEC))


def mpcdi():
    """The profile sl. Angles from the axis to the edges; the raster's corner is half a pixel before OpenCV's (0, 0)."""
    (fx, fy), (cx, cy) = K[[0, 1], [0, 1]], K[:2, 2] + 0.5
    angle = lambda part, focal: float(np.degrees(np.arctan(part / focal)))
    position = -R.T @ T
    axes = {"pitch": R[0], "yaw": R[1], "roll": R[2]}
    frame = "".join(f"<pos{a}>{position[i]!r}</pos{a}>".replace("np.float64(", "").replace(")", "") for i, a in enumerate("xyz"))
    for name, axis in axes.items():
        frame += "".join(f"<{name}{a}>{float(axis[i])!r}</{name}{a}>" for i, a in enumerate("xyz"))
    edges = {"rightAngle": angle(SIZE[0] - cx, fx), "leftAngle": -angle(cx, fx), "upAngle": angle(cy, fy),
             "downAngle": -angle(SIZE[1] - cy, fy)}
    frustum = "<yaw>0</yaw><pitch>0</pitch><roll>0</roll>" + "".join(f"<{k}>{v!r}</{k}>" for k, v in edges.items())
    return (f'<?xml version="1.0" encoding="utf-8"?>\n<MPCDI profile="sl" geometry="1" color="0" version="2.0"><display>'
            f'<buffer id="b"><region id="r0" xResolution="{SIZE[0]}" yResolution="{SIZE[1]}" x="0" y="0" xsize="1" ysize="1">'
            f"<frustum>{frustum}</frustum><coordinateFrame>{frame}</coordinateFrame></region></buffer></display></MPCDI>\n")


def main():
    OUT.mkdir(parents=True, exist_ok=True)
    lists = {"K": K.tolist(), "dist": LENS.tolist(), "rvec": RVEC.ravel().tolist(), "tvec": T.tolist()}
    rows = []

    def add(name, unit="metre", device="-", frame="world", right="lens"):
        rows.append("\t".join((name, unit, device, frame, right)))

    storage("opencv.xml", flat)
    add("opencv.xml")
    storage("opencv.json", flat)
    add("opencv.json")
    storage("opencv.yml", flat)
    (OUT / "opencv.yml.gz").write_bytes(gzip.compress((OUT / "opencv.yml").read_bytes(), mtime=0))
    (OUT / "opencv.yml").unlink()
    add("opencv.yml.gz")
    storage("nested.yml", nested)
    add("nested.yml")
    storage("procamcalib.yml", procamcalib)
    add("procamcalib.yml", "millimetre", "Projector  0", "world of camera")
    storage("slstudio.xml", lambda f: two_devices(("Kc", "kc", "Kp", "kp", "Rp", "Tp"), 1000, f))
    add("slstudio.xml", "millimetre", "-", "camera")
    storage("scan3d.yml", lambda f: two_devices(("cam_K", "cam_kc", "proj_K", "proj_kc", "R", "T"), 1000, f))
    add("scan3d.yml", "millimetre", "projector", "camera")
    storage("mapamok.yml", mapamok)
    add("mapamok.yml")
    # kalibr has four coefficients; its pose is called after the inertial unit.
    kalibr = {"cam0": {"camera_model": "pinhole", "intrinsics": [1480.0, 1510.0, 508.5, 702.25], "distortion_model": "radtan",
                       "distortion_coeffs": LENS[:4].tolist(), "resolution": list(SIZE), "T_cam_imu": POSE.tolist()}}
    (OUT / "kalibr.yaml").write_text(yaml.safe_dump(kalibr))
    add("kalibr.yaml", right="lens of four")
    table = lambda rows, cols, data: {"rows": rows, "cols": cols, "data": data}
    info = {"image_width": SIZE[0], "image_height": SIZE[1], "camera_name": "projector",
            "camera_matrix": table(3, 3, K.ravel().tolist()), "distortion_model": "plumb_bob",
            "distortion_coefficients": table(1, 5, LENS.tolist()),
            "rectification_matrix": table(3, 3, np.eye(3).ravel().tolist()),
            "projection_matrix": table(3, 4, np.column_stack([K, np.zeros(3)]).ravel().tolist()),
            "rvec": lists["rvec"], "tvec": lists["tvec"]}
    (OUT / "camera_info.yaml").write_text(yaml.safe_dump(info, sort_keys=False))
    add("camera_info.yaml")
    (OUT / "pose.json").write_text(json.dumps({"K": lists["K"], "dist": lists["dist"], "world_to_camera": POSE.tolist()}, indent=1))
    add("pose.json")
    (OUT / "placement.json").write_text(json.dumps({"K": lists["K"], "dist": lists["dist"], "camera_to_world": np.linalg.inv(POSE).tolist()}))
    add("placement.json")
    (OUT / "python.yaml").write_text(yaml.safe_dump({"mtx": lists["K"], "dist": [lists["dist"]], "rvec": RVEC.tolist(), "tvec": T.reshape(3, 1).tolist()}))
    add("python.yaml")
    single = {"width": SIZE[0], "height": SIZE[1], "fx": 1480.0, "fy": 1510.0, "ppx": 508.5, "ppy": 702.25, "k1": LENS[0],
              "k2": LENS[1], "p1": LENS[2], "p2": LENS[3], "k3": LENS[4], "R": R.ravel().tolist(), "t": lists["tvec"]}
    (OUT / "single.json").write_text(json.dumps(single, indent=1))
    add("single.json")
    archive = zipfile.ZipFile(OUT / "lamp.mpcdi", "w", zipfile.ZIP_DEFLATED)
    archive.writestr(zipfile.ZipInfo("mpcdi.xml", (2026, 1, 1, 0, 0, 0)), mpcdi(), zipfile.ZIP_DEFLATED)
    archive.close()
    add("lamp.mpcdi", right="no lens")
    with zipfile.ZipFile(OUT / "numpy.npz", "w") as archive:
        import io

        for name, value in (("mtx", K), ("dist", LENS), ("rvec", RVEC), ("tvec", T)):
            content = io.BytesIO()
            np.save(content, value)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", (2026, 1, 1, 0, 0, 0)), content.getvalue())
    add("numpy.npz", right="refused: save mtx, dist, rvec, tvec as JSON")
    (OUT / "dialects.tsv").write_text("file\tunit\tdevice\tframe\tright\n" + "\n".join(rows) + "\n")

    # Points whose pixels cover the raster, at several depths.
    pixels = np.array([[x, y] for y in np.linspace(0, SIZE[1] - 1, 9) for x in np.linspace(0, SIZE[0] - 1, 9)])
    rays = np.column_stack([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(pixels))])
    depth = np.array([0.8, 1.2, 1.9])[np.arange(len(rays)) % 3]
    world = np.round((rays * depth[:, None] - T) @ R, 6)
    table = [world]
    for lens in (LENS, LENS[:4], np.zeros(4)):
        table.append(cv2.projectPoints(world.reshape(-1, 1, 3), RVEC, T, K, lens)[0].reshape(-1, 2))
    lines = [",".join(f"{v:.9g}" if i < 3 else f"{v:.6f}" for i, v in enumerate(row)) for row in np.hstack(table)]
    (OUT / "pixels.csv").write_text("x,y,z,u,v,u of four,v of four,u without,v without\n" + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
