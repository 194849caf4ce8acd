"""Reads the files of exported/ with OpenCV and holds them to the files that OpenCV wrote.

Passed with OpenCV 4.14.0 and 5.0.0. The test `an_export_keeps_its_bytes` of dpm-scene writes exported/ (with
DPM_UPDATE_EXPORTS=1) and holds later exports to the same bytes.
"""

import pathlib

import cv2
import numpy as np

HERE = pathlib.Path(__file__).parent


def main():
    checked = 0
    for path in sorted((HERE / "exported").iterdir()):
        ours = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        theirs = cv2.FileStorage(str(HERE / path.name), cv2.FILE_STORAGE_READ)
        for name in ("image_width", "image_height", "fisheye_model"):
            if theirs.getNode(name).empty():
                assert ours.getNode(name).empty(), (path, name)
            else:
                assert ours.getNode(name).isInt() and ours.getNode(name).real() == theirs.getNode(name).real()
        for name in ("camera_matrix", "distortion_coefficients", "rvec", "tvec"):
            got, want = ours.getNode(name).mat(), theirs.getNode(name).mat()
            assert (got is None) == (want is None), (path, name)
            if got is not None:
                assert got.shape == want.shape and np.abs(got - want).max() < 1e-12, (path, name, got, want)
        checked += 1
    assert checked == 21, checked
    print(f"OpenCV {cv2.__version__} reads {checked} exported files as they are meant")


if __name__ == "__main__":
    main()
