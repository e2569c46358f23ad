"""OpenCV 4 beside NumPy 1 (as in Slicer 5.8) and OpenCV 5 differ in a few names; pictures are read with both."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from MedColorLib.errors import InputError
from MedColorLib.io.pictures import quiet_cv2
from MedColorLib.references.pictures import read_picture


class Log:
    """In place of OpenCV's log level: what it was set to."""

    def __init__(self):
        self.levels = [3]

    def getLogLevel(self):
        return self.levels[-1]

    def setLogLevel(self, level):
        self.levels.append(level)


@pytest.mark.parametrize("version", [4, 5])
def test_the_log_is_silenced_and_given_back(monkeypatch, version):
    log = Log()
    if version == 4:
        monkeypatch.setattr(cv2, "getLogLevel", log.getLogLevel, raising=False)
        monkeypatch.setattr(cv2, "setLogLevel", log.setLogLevel, raising=False)
        monkeypatch.delattr(cv2.utils, "logging", raising=False)
    else:
        monkeypatch.delattr(cv2, "setLogLevel", raising=False)
        monkeypatch.setattr(cv2, "utils", SimpleNamespace(logging=log))
    with pytest.raises(ZeroDivisionError), quiet_cv2():
        assert log.levels == [3, 0]
        raise ZeroDivisionError
    assert log.levels == [3, 0, 3]


def test_pictures_are_read_with_the_installed_one(tmp_path, capfd):
    picture = np.random.default_rng(0).integers(0, 256, (6, 5, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "picture.png"), picture[..., ::-1])
    np.testing.assert_array_equal(read_picture(tmp_path / "picture.png"), picture)
    (tmp_path / "cut.png").write_bytes((tmp_path / "picture.png").read_bytes()[:60])
    with pytest.raises(InputError):
        read_picture(tmp_path / "cut.png")
    assert capfd.readouterr().err == ""
