#!/usr/bin/env python3
"""Writes one projector in the dialects of many calibration programs, and the pixels to which OpenCV itself takes points.

    python3 -m venv V && V/bin/pip install opencv-python-headless numpy pyyaml
    V/bin/python tests/peers/calibrations.py

`tests/assets/dialects/` has what it writes: the files, `dialects.tsv` with what a person says of each (unit, device, frame)
and what is right of it, and `pixels.csv` with world points [m] and their pixels by cv2.projectPoints (OpenCV's, with the
centres of pixels at whole numbers): with the lens of all files, of four numbers, without one (MPCDI has none), and a fisheye. Nothing is
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
# Equidistant.
FISHEYE = np.array([0.02, -0.004, 0.001, -0.0002])
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


def link(vector, shift):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = cv2.Rodrigues(np.array(vector))[0], shift
    return out


def kalibr_chains(add):
    """Cameras that are told from the one before, the first one from the inertial unit or from nothing."""
    one = {"camera_model": "pinhole", "distortion_model": "radtan", "resolution": list(SIZE)}
    other = {**one, "intrinsics": [900.0, 905.0, 327.0, 235.0], "distortion_coeffs": CAMERA_LENS[:4].tolist()}
    ours = {**one, "intrinsics": [1480.0, 1510.0, 508.5, 702.25], "distortion_coeffs": LENS[:4].tolist()}
    first, second = link([0.1, -0.2, 0.05], [0.1, 0.02, -0.03]), link([-0.05, 0.1, 0.02], [-0.05, 0.01, 0.02])
    before = np.linalg.inv(second @ first) @ POSE
    from_unit = [{**other, "T_cam_imu": before.tolist()}, {**other, "T_cn_cnm1": first.tolist()}, {**ours, "T_cn_cnm1": second.tolist()}]
    from_camera = [other, {**other, "T_cn_cnm1": first.tolist()}, {**ours, "T_cn_cnm1": (POSE @ np.linalg.inv(first)).tolist()}]
    for name, cameras, frame in (("unit", from_unit, "world"), ("camera", from_camera, "camera")):
        (OUT / f"kalibr-chain-{name}.yaml").write_text(yaml.safe_dump({f"cam{i}": c for i, c in enumerate(cameras)}))
        add(f"kalibr-chain-{name}.yaml", device="cam2", frame=frame, right="lens of four")


def kalibr_models(add):
    intrinsics = [1480.0, 1510.0, 508.5, 702.25]
    base = {"resolution": list(SIZE), "T_cam_imu": POSE.tolist()}
    four = LENS[:4].tolist()
    for name, model, more, lens, numbers, right in (
        ("equi", "pinhole", [], "equidistant", FISHEYE.tolist(), "fisheye"),
        ("omni", "omni", [1.1], "radtan", four, "refused: omnidirectional, cv2.fisheye"),
        ("eucm", "eucm", [0.6, 1.05], "none", [], "refused: EUCM, cv2.fisheye"),
        ("ds", "ds", [-0.2, 0.6], "none", [], "refused: double sphere, cv2.fisheye"),
        ("fov", "pinhole", [], "fov", [0.92], "refused: FOV, cv2.fisheye"),
    ):
        camera = {**base, "camera_model": model, "intrinsics": more + intrinsics, "distortion_model": lens, "distortion_coeffs": numbers}
        (OUT / f"kalibr-{name}.yaml").write_text(yaml.safe_dump({"cam0": camera}))
        add(f"kalibr-{name}.yaml", right=right)


def camodocal(add):
    head = f"%YAML:1.0\n---\nimage_width: {SIZE[0]}\nimage_height: {SIZE[1]}\nrvec: {RVEC.ravel().tolist()}\ntvec: {T.tolist()}\n"
    block = lambda name, entries: f"{name}:\n" + "".join(f"   {k}: {v}\n" for k, v in entries.items())
    brown = dict(zip(("k1", "k2", "p1", "p2"), LENS.tolist()))
    focal = lambda a, b, c, d: {a: 1480.0, b: 1510.0, c: 508.5, d: 702.25}
    for name, model, blocks, right in (
        ("pinhole", "PINHOLE", [("distortion_parameters", brown), ("projection_parameters", focal("fx", "fy", "cx", "cy"))], "lens of four"),
        ("kb", "KANNALA_BRANDT", [("projection_parameters", {**dict(zip(("k2", "k3", "k4", "k5"), FISHEYE.tolist())), **focal("mu", "mv", "u0", "v0")})], "fisheye"),
        ("mei", "MEI", [("mirror_parameters", {"xi": 1.9}), ("distortion_parameters", brown), ("projection_parameters", focal("gamma1", "gamma2", "u0", "v0"))], "refused: omnidirectional, cv2.fisheye"),
        ("scaramuzza", "scaramuzza", [("poly_parameters", {"p0": -400.0, "p1": 0.0}), ("affine_parameters", {"ac": 1.0, "cx": 500.0, "cy": 380.0})], "refused: no intrinsics"),
    ):
        text = head + f"model_type: {model}\n" + "".join(block(*b) for b in blocks)
        (OUT / f"camodocal-{name}.yml").write_text(text)
        add(f"camodocal-{name}.yml", right=right)


def robots(add):
    """ORB-SLAM, EuRoC, ROS's topic, and a stereo pair of OpenCV's sample."""
    pose_text = f"rvec: {RVEC.ravel().tolist()}\ntvec: {T.tolist()}\n"
    for name, model, coefficients, right in (
        ("orbslam", "PinHole", dict(zip(("k1", "k2", "p1", "p2", "k3"), LENS.tolist())), "lens"),
        ("orbslam-kb", "KannalaBrandt8", dict(zip(("k1", "k2", "k3", "k4"), FISHEYE.tolist())), "fisheye"),
    ):
        numbers = {"fx": 1480.0, "fy": 1510.0, "cx": 508.5, "cy": 702.25, **coefficients, "width": SIZE[0], "height": SIZE[1]}
        text = f'%YAML:1.0\nCamera.type: "{model}"\n' + "".join(f"Camera.{k}: {v}\n" for k, v in numbers.items()) + pose_text
        (OUT / f"{name}.yaml").write_text(text)
        add(f"{name}.yaml", device="camera", right=right)
    (OUT / "euroc.yaml").write_text(
        "sensor_type: camera\ncomment: cam0\n\nT_BS:\n  cols: 4\n  rows: 4\n"
        f"  data: {np.linalg.inv(POSE).ravel().tolist()}\n\nrate_hz: 20\nresolution: [{SIZE[0]}, {SIZE[1]}]\ncamera_model: pinhole\n"
        f"intrinsics: [1480.0, 1510.0, 508.5, 702.25] #fu, fv, cu, cv\ndistortion_model: radial-tangential\ndistortion_coefficients: {LENS[:4].tolist()}\n")
    add("euroc.yaml", right="lens of four")
    (OUT / "camera_info-topic.yaml").write_text(
        f"header:\n  frame_id: camera\nheight: {SIZE[1]}\nwidth: {SIZE[0]}\ndistortion_model: plumb_bob\nD: {LENS.tolist()}\nK: {K.ravel().tolist()}\n"
        f"R: {np.eye(3).ravel().tolist()}\nP: {np.column_stack([K, np.zeros(3)]).ravel().tolist()}\nroi:\n  x_offset: 0\n  height: 0\n  width: 0\n")
    add("camera_info-topic.yaml", right="refused: no translation")
    r1, r2, p1, p2, q = cv2.stereoRectify(CAMERA, CAMERA_LENS, K, LENS, SIZE, R, T.reshape(3, 1))[:5]
    pairs = (("M1", CAMERA), ("D1", CAMERA_LENS), ("M2", K), ("D2", LENS.reshape(1, -1)), ("R", R), ("T", T.reshape(3, 1)),
             ("R1", r1), ("R2", r2), ("P1", p1), ("P2", p2), ("Q", q))
    storage("stereo.yml", lambda f: [f.write(*pair) for pair in pairs])
    add("stereo.yml", device="2", frame="camera")
    storage("omnidir.yml", lambda f: [f.write(*pair) for pair in (("K", K), ("D", LENS[:4]), ("xi", np.array([[1.2]])), ("rvec", RVEC), ("tvec", T))])
    add("omnidir.yml", right="refused: omnidirectional, cv2.fisheye")


def sensors(add):
    numbers = {"width": SIZE[0], "height": SIZE[1], "ppx": 508.5, "ppy": 702.25, "fx": 1480.0, "fy": 1510.0, "coeffs": LENS.tolist(),
               "rotation": R.ravel().tolist(), "translation": T.tolist()}
    for name, model, right in (
        ("brown", "distortion.brown_conrady", "lens"), ("four", 4, "lens"), ("named", "LAMP 3000", "lens"),
        ("inverse", "distortion.inverse_brown_conrady", "refused: inverse, calibrateCamera"), ("two", 2, "refused: inverse, calibrateCamera"),
    ):
        (OUT / f"realsense-{name}.json").write_text(json.dumps({**numbers, "model": model}))
        add(f"realsense-{name}.json", right=right)
    focal = {"fx": 1480.0, "fy": 1510.0, "cx": 508.5, "cy": 702.25}
    unit = {"px": 0.1, "py": 0.2, "pz": 0.3, "qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}
    for name, more, right in (("ds", {"xi": -0.2, "alpha": 0.6}, "double sphere"), ("kb4", dict(zip(("k1", "k2", "k3", "k4"), FISHEYE.tolist())), "Basalt, JSON")):
        value = {"T_imu_cam": [unit], "intrinsics": [{"camera_type": name, "intrinsics": {**focal, **more}}], "resolution": [list(SIZE)]}
        (OUT / f"basalt-{name}.json").write_text(json.dumps({"value0": value}))
        add(f"basalt-{name}.json", right=f"refused: {right}")
    azure = {"Intrinsics": {"ModelParameters": [0.5, 0.51, 0.49, 0.49, 0.3], "ModelType": "CALIBRATION_LensDistortionModelBrownConrady"},
             "Rt": {"Rotation": R.ravel().tolist(), "Translation": T.tolist()}}
    (OUT / "azure.json").write_text(json.dumps({"CalibrationInformation": {"Cameras": [azure]}}))
    add("azure.json", right="refused: Azure Kinect, JSON")
    matlab = {"K": K.tolist(), "RadialDistortion": [-0.08, 0.05], "TangentialDistortion": [0.002, -0.003], "ImageSize": [768, 1024], "R": R.tolist(), "T": T.tolist()}
    (OUT / "matlab.json").write_text(json.dumps(matlab))
    add("matlab.json", right="refused: MATLAB, cameraIntrinsicsToOpenCV")
    turned = {"K": K.tolist(), "dist": LENS.tolist(), "quaternion": [0.1, 0.2, 0.3, 0.9], "tvec": T.tolist()}
    (OUT / "quaternion.json").write_text(json.dumps(turned))
    add("quaternion.json", right="refused: quaternion, rotation matrix R")


def photogrammetry(add):
    place = np.linalg.inv(POSE)
    nerf = {"fl_x": 1480.0, "fl_y": 1510.0, "cx": 509.0, "cy": 702.75, "w": SIZE[0], "h": SIZE[1],
            "frames": [{"file_path": "a.png", "transform_matrix": (place @ np.diag([1, -1, -1, 1])).tolist()}]}
    texts = (
        ("transforms.json", json.dumps(nerf), "nerfstudio, 0.5"),
        ("cameras.txt", "# Camera list with one line of data per camera:\n1 OPENCV 1024 768 1480 1510 509 702.75 -0.08 0.05 0.002 -0.003\n", "COLMAP, 0.5"),
        ("bundler.out", "# Bundle file v0.3\n1 0\n1480 -0.08 0.05\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n", "Bundler, JSON"),
        ("agisoft.xml", "<?xml version=\"1.0\"?>\n<calibration>\n  <projection>frame</projection>\n  <width>1024</width>\n  <height>768</height>\n"
         "  <f>1510</f>\n  <cx>-3.5</cx>\n  <cy>318.25</cy>\n  <k1>-0.08</k1>\n</calibration>\n", "Agisoft, OpenCV"),
        ("calibu.xml", "<rig>\n<camera>\n<camera_model type=\"calibu_fu_fv_u0_v0\">\n<params> [ 1480; 1510; 508.5; 702.25 ] </params>\n</camera_model>\n"
         "</camera>\n</rig>\n", "Calibu, JSON"),
        ("ost.ini", "# oST version 5.0 parameters\n\n[image]\n\nwidth\n1024\n\nheight\n768\n", "convert, YAML"),
        ("anipose.toml", f"[cam_0]\nname = \"a\"\nsize = [ 1024, 768,]\nmatrix = {K.tolist()}\ndistortions = {LENS.tolist()}\n"
         f"rotation = {RVEC.ravel().tolist()}\ntranslation = {T.tolist()}\n", "Anipose, JSON"),
    )
    for name, text, right in texts:
        (OUT / name).write_text(text)
        add(name, right=f"refused: {right}")


def strangers(add):
    """What people who calibrate cameras bring."""
    for write in (kalibr_chains, kalibr_models, camodocal, robots, sensors, photogrammetry):
        write(add)


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
    strangers(add)
    (OUT / "dialects.tsv").write_text("file\tunit\tdevice\tframe\tright\n" + "\n".join(rows) + "\n")

    # Points whose pixels cover the raster, at several depths.
    pixels = np.array([[x, y] for y in np.linspace(0, SIZE[1] - 1, 9) for x in np.linspace(0, SIZE[0] - 1, 9)])
    rays = np.column_stack([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(pixels))])
    depth = np.array([0.8, 1.2, 1.9])[np.arange(len(rays)) % 3]
    world = np.round((rays * depth[:, None] - T) @ R, 6)
    table = [world]
    for lens in (LENS, LENS[:4], np.zeros(4)):
        table.append(cv2.projectPoints(world.reshape(-1, 1, 3), RVEC, T, K, lens)[0].reshape(-1, 2))
    table.append(cv2.fisheye.projectPoints(world.reshape(1, -1, 3), RVEC, T, K, FISHEYE)[0].reshape(-1, 2))
    lines = [",".join(f"{v:.9g}" if i < 3 else f"{v:.6f}" for i, v in enumerate(row)) for row in np.hstack(table)]
    (OUT / "pixels.csv").write_text("x,y,z,u,v,u of four,v of four,u without,v without,u of fisheye,v of fisheye\n" + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
