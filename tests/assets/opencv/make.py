"""Writes the calibration files of this folder and their golden projections with OpenCV itself.

Made with OpenCV 5.0.0 (opencv-python-headless 5.0.0) and numpy 2.4.6. Run `python3 make.py` in this folder to write all
files again; nothing is random. For every lens model there are:

- MODEL.xml, MODEL.yml and MODEL.json: the same calibration of a 1024 x 768 projector, in metres, by cv2.FileStorage.
- MODEL.csv: world points [m] and the pixels to which cv2.projectPoints or cv2.fisheye.projectPoints takes them.
  The pixels are OpenCV's, with the centres of the pixels at whole numbers. The points lie at 0.6 to 2.6 m and their
  pixels cover the raster up to its edges.
- MODEL.triangles.csv: triangles of some twelve pixels all over the raster and in depth. A line has the three corners in
  the world [m], and the six pixels to which OpenCV takes the corners and the middles of the edges, going around.
"""

import pathlib

import cv2
import numpy as np

HERE = pathlib.Path(__file__).parent
SIZE = (1024, 768)
# The axis leaves near the lower edge, as it does in most projectors.
MATRIX = np.array([[1100.0, 0, 530.25], [0, 1085.0, 610.75], [0, 0, 1]])
# Strong lenses, which do not fold within the raster (0.57 by 0.56 in x / z).
MODELS = {
    "none": [],
    "brown4": [-0.21, 0.09, 0.004, -0.003],
    "brown5": [-0.24, 0.12, 0.003, -0.004, -0.03],
    "rational8": [0.35, -0.18, -0.002, 0.003, 0.05, 0.55, -0.1, 0.02],
    "prism12": [0.3, -0.15, 0.003, 0.002, 0.04, 0.45, -0.08, 0.01, 0.012, -0.004, -0.009, 0.006],
    "tilted14": [-0.2, 0.08, 0.002, -0.003, -0.02, 0.03, 0.01, 0.002, 0.006, -0.003, -0.005, 0.004, 0.05, -0.035],
    "fisheye": [-0.08, 0.03, -0.015, 0.004],
}


def pose():
    """The rotation and translation that take points of the world into OpenCV's camera."""
    position = np.array([0.45, 0.7, 1.6])
    forward = np.array([0.05, 0.1, 0.0]) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.06, 1.0, 0.02])
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(forward, right), forward])
    return rotation, -rotation @ position


def project(model, world, rotation, translation, coefficients):
    """Pixels of world points."""
    vector = cv2.Rodrigues(rotation)[0]
    world = world.reshape(-1, 1, 3)
    if model == "fisheye":
        pixels = cv2.fisheye.projectPoints(world, vector, translation, MATRIX, coefficients)[0]
    else:
        pixels = cv2.projectPoints(world, vector, translation, MATRIX, coefficients)[0]
    return pixels.reshape(-1, 2)


def rays_of(model, pixels, coefficients):
    """Straight rays x / z, y / z of pixels, by Newton's method on OpenCV's own projection."""

    def bend(rays):
        world = np.column_stack([rays, np.ones(len(rays))])
        return project(model, world, np.eye(3), np.zeros(3), coefficients)

    rays = (pixels - MATRIX[:2, 2]) / MATRIX[[0, 1], [0, 1]]
    step = 1e-6
    for _ in range(30):
        error = bend(rays) - pixels
        by_x = (bend(rays + [step, 0]) - bend(rays - [step, 0])) / (2 * step)
        by_y = (bend(rays + [0, step]) - bend(rays - [0, step])) / (2 * step)
        rays -= np.linalg.solve(np.stack([by_x, by_y], axis=2), error[:, :, None])[:, :, 0]
    # A lens that folds within the raster would mirror the neighbourhood of a pixel.
    assert (np.linalg.det(np.stack([by_x, by_y], axis=2)) > 0).all(), model
    return rays


def points(model, rotation, translation, coefficients):
    """World points, to the micrometre, whose pixels cover the raster, and these pixels."""
    columns = np.linspace(0.5, SIZE[0] - 1.5, 15)
    rows = np.linspace(0.5, SIZE[1] - 1.5, 14)
    pixels = np.array([[x, y] for y in rows for x in columns])
    rays = rays_of(model, pixels, coefficients)
    index = np.arange(len(pixels))
    depth = 0.6 + 2.0 * ((index * 7) % 19) / 18.0
    in_camera = np.column_stack([rays * depth[:, None], depth])
    world = np.round((in_camera - translation) @ rotation, 6)
    got = project(model, world, rotation, translation, coefficients)
    assert np.abs(got - pixels).max() < 0.01, (model, np.abs(got - pixels).max())
    return world, got


def triangles(model, rotation, translation, coefficients):
    """Corners in the world (n x 3 x 3) and the outlines that OpenCV sees (n x 6 x 2)."""
    centres = np.array([[x, y] for y in np.linspace(12, SIZE[1] - 13, 5) for x in np.linspace(12, SIZE[0] - 13, 7)])
    index = np.arange(len(centres))
    # Every triangle is turned and tilted otherwise, and moved by less than a pixel.
    centres = centres + np.column_stack([(index * 0.618) % 1.0, (index * 0.414) % 1.0])
    angles = index[:, None] * 0.37 + np.array([0.0, 2.1, 4.2])
    pixels = centres[:, None, :] + 8.0 * np.stack([np.cos(angles), np.sin(angles)], axis=2)
    rays = rays_of(model, pixels.reshape(-1, 2), coefficients)
    depth = (0.6 + 2.0 * ((index * 11) % 35) / 34.0)[:, None] * (1.0 + 0.01 * np.cos(angles * 3.0 + index[:, None]))
    in_camera = np.column_stack([rays, np.ones(len(rays))]) * depth.reshape(-1, 1)
    corners = np.round((in_camera - translation) @ rotation, 6).reshape(-1, 3, 3)
    middles = (corners + np.roll(corners, -1, axis=1)) / 2.0
    around = np.stack([corners, middles], axis=2).reshape(-1, 3)
    outline = project(model, around, rotation, translation, coefficients)
    return corners, outline.reshape(-1, 6, 2)


def write(path, model, vector, translation, coefficients):
    """One calibration file in OpenCV's own form."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", SIZE[0])
    storage.write("image_height", SIZE[1])
    storage.write("camera_matrix", MATRIX)
    if len(coefficients):
        storage.write("distortion_coefficients", coefficients.reshape(-1, 1))
    if model == "fisheye":
        storage.write("fisheye_model", 1)
    storage.write("rvec", vector)
    storage.write("tvec", translation.reshape(3, 1))
    storage.write("avg_reprojection_error", 0.125)
    storage.release()


def main():
    rotation, translation = pose()
    vector = cv2.Rodrigues(rotation)[0]
    for model, values in MODELS.items():
        coefficients = np.array(values)
        for form in ("xml", "yml", "json"):
            write(HERE / f"{model}.{form}", model, vector, translation, coefficients)
        world, pixels = points(model, rotation, translation, coefficients)
        lines = ["x_m,y_m,z_m,u_px,v_px"]
        for (x, y, z), (u, v) in zip(world, pixels):
            lines.append(f"{x:.6f},{y:.6f},{z:.6f},{u:.9f},{v:.9f}")
        (HERE / f"{model}.csv").write_text("\n".join(lines) + "\n")
        lines = ["x0_m,y0_m,z0_m,x1_m,y1_m,z1_m,x2_m,y2_m,z2_m," + ",".join(f"u{i}_px,v{i}_px" for i in range(6))]
        for corners, outline in zip(*triangles(model, rotation, translation, coefficients)):
            numbers = [f"{v:.6f}" for v in corners.ravel()] + [f"{v:.5f}" for v in outline.ravel()]
            lines.append(",".join(numbers))
        (HERE / f"{model}.triangles.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
